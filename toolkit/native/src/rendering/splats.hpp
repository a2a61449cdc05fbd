// State of one rasterisation: projected Gaussians, their tiles, and what backward needs.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "common/camera.hpp"
#include "common/constants.hpp"

namespace semsplat {

enum { BLOCK = 4, BLOCKS = 16, TILE_PIXELS = TILE * TILE };
static_assert(TILE * TILE == BLOCKS * BLOCK * BLOCK, "a tile consists of 16 blocks of 4x4 pixels");

// Uninitialised storage: a vector would spend time on writing zeros.
template <class T>
class Buffer {
  public:
    void resize(size_t n) {
        if (n > capacity_) {
            capacity_ = n + n / 4;
            data_.reset(new T[capacity_]);
        }
        size_ = n;
    }
    T* data() { return data_.get(); }
    const T* data() const { return data_.get(); }
    size_t size() const { return size_; }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }

  private:
    std::unique_ptr<T[]> data_;
    size_t size_ = 0, capacity_ = 0;
};

// One Gaussian as the tiles see it: one cache line.
struct alignas(64) Splat {
    float u, v, z;           // pixel centre and camera depth (m)
    float sigma;             // standard deviation in pixels
    float exponent;          // -0.5 / sigma^2
    float opacity;
    float support_squared;   // squared pixel distance at which alpha falls under the cut
    float r, g, b;
    int32_t id;              // index in the map
    int32_t slot;            // first gradient slot, or -1: it touches one tile only
    int16_t tile_x0, tile_y0, tile_x1, tile_y1;
    int32_t pairs;           // tiles touched
    int32_t padding;
};
static_assert(sizeof(Splat) == 64, "a splat fills one cache line");

struct Gaussians {
    int64_t count;
    const float* means;          // [N, 3]
    const float* log_radii;      // [N]
    const float* opacity_logits; // [N]
    const float* colours;        // [N, 3]
    const float* features;       // [N, S] or null
    int feature_channels;        // S
    bool centres;                // composite the means as three more channels, after the features
    int extra_channels() const { return feature_channels + (centres ? 3 : 0); }
};

// Everything that forward leaves for backward.
struct Rasterisation {
    Pinhole camera;
    float R[9], t[3];
    int tiles_x = 0, tiles_y = 0;
    Buffer<Splat> splats;              // visible Gaussians, by index in the map
    Buffer<int32_t> tile_begin;        // [tiles + 1] into the pairs
    Buffer<int32_t> pair_splat;        // by tile, front to back
    Buffer<int32_t> pair_slot;         // where the pair's gradient goes, -1: the splat's own
    Buffer<int32_t> block_end;         // [tiles, 16] pairs (from the tile's begin) each block used
    Buffer<float> transmittance;       // [tiles, 256] what is left, blocks of 4x4 pixels
    int64_t slots = 0;
    int tiles() const { return tiles_x * tiles_y; }
};

// Gradients of the visible Gaussians, in the order of `splats`.
struct GradientSinks {
    float* means;           // [V, 3]
    float* log_radii;       // [V]
    float* opacity_logits;  // [V]
    float* colours;         // [V, 3] or null
    float* features;        // [V, S]
    double* T_camera_map;   // [3, 4]
};

void project(const Gaussians& gaussians, Rasterisation& out);
void bin(const uint8_t* region, Rasterisation& out);
// images: [5 + S (+ 3), H, W]: red, green, blue, depth (m, times weight), silhouette, features,
// and the centres where they are asked for.
void composite(const Gaussians& gaussians, const uint8_t* region, Rasterisation& state, float* images);
// image_gradients: [5 + S, H, W]. `detached`: what the feature channels ask for goes to the
// features alone, and leaves geometry, opacity and pose as they are.
void differentiate(const Gaussians& gaussians, const uint8_t* region, const Rasterisation& state,
                   const float* image_gradients, bool detached, const GradientSinks& sinks);

}  // namespace semsplat
