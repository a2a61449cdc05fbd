// State of one rasterisation: projected Gaussians, their tiles, and data for the backward pass.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "common/camera.hpp"
#include "common/constants.hpp"

namespace semsplat {

enum { TILE_PIXELS = TILE * TILE };

// Uninitialised storage; std::vector would initialise the memory.
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

// One projected Gaussian; the size of a cache line.
struct alignas(64) Splat {
    float u, v, z;           // pixel centre and camera depth (m)
    float sigma;             // standard deviation in pixels
    float exponent;          // -0.5 / sigma^2
    float opacity;
    float support_squared;   // squared distance in pixels at which alpha falls below MIN_ALPHA
    float r, g, b;
    int32_t id;              // index in the map
    int32_t slot;            // first gradient slot, or -1 if it overlaps a single tile
    int16_t tile_x0, tile_y0, tile_x1, tile_y1;
    int32_t pairs;           // number of overlapped tiles
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
    bool centres;                // composite the means as three additional channels after the features
    int extra_channels() const { return feature_channels + (centres ? 3 : 0); }
};

// Results of the forward pass that the backward pass needs.
struct Rasterisation {
    Pinhole camera;
    float R[9], t[3];
    int tiles_x = 0, tiles_y = 0;
    Buffer<Splat> splats;              // visible Gaussians, by index in the map
    Buffer<int32_t> tile_begin;        // [tiles + 1] into the pairs
    Buffer<int32_t> pair_splat;        // by tile, front to back
    Buffer<int32_t> pair_slot;         // gradient slot of the pair, or -1 for the row of the splat
    Buffer<int32_t> block_end;         // [tiles, BLOCKS] number of the tile's pairs each block used
    Buffer<float> transmittance;       // [tiles, 256] final transmittance, in blocks (tile.hpp)
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
// images: [5 + S (+ 3), H, W]: red, green, blue, weighted depth (m), silhouette, features, and
// the centres if requested.
void composite(const Gaussians& gaussians, const uint8_t* region, Rasterisation& state, float* images);
// image_gradients: [5 + S, H, W]. `detached`: gradients of the feature channels are propagated to
// the features only, not to geometry, opacity and pose.
void differentiate(const Gaussians& gaussians, const uint8_t* region, const Rasterisation& state,
                   const float* image_gradients, bool detached, const GradientSinks& sinks);

}  // namespace semsplat
