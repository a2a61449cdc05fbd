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

// Largest support in standard deviations, at opacity 1: sqrt(2 ln (1 / MIN_ALPHA)).
constexpr float MAX_SUPPORT = 3.3291f;

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

// What a map consists of. Spheres are separable in the image, and so much faster than ellipsoids.
enum class Shape { SPHERE, ELLIPSOID };

// One projected Gaussian; the size of a cache line.
struct alignas(64) Splat {
    float u, v, z;           // pixel centre and camera depth (m)
    // Exponent of a sphere: shape_a (dx^2 + dy^2). Of an ellipsoid:
    // -(shape_a dx + shape_b dy)^2 - (shape_c dy)^2, which does not cancel for thin ellipses.
    float shape_a, shape_b, shape_c;
    float opacity;
    // Where alpha falls below MIN_ALPHA: the squared distance in pixels for a sphere, the negative
    // exponent for an ellipsoid.
    float support;
    float r, g, b;
    int32_t id;              // index in the map
    int32_t slot;            // first gradient slot, or -1 if it overlaps a single tile
    int16_t tile_x0, tile_y0, tile_x1, tile_y1;
    int32_t pairs;           // number of overlapped tiles
};
static_assert(sizeof(Splat) == 64, "a splat fills one cache line");

// Depth of an ellipsoid along the rays: that of its centre plus along_s s + along_t t, with the
// coordinates s and t of `whitened` (tile.hpp).
struct Slope {
    float along_s, along_t;
};

struct Gaussians {
    int64_t count;
    const float* means;          // [N, 3]
    const float* log_radii;      // [N], of spheres
    const float* opacity_logits; // [N]
    const float* colours;        // [N, 3]
    const float* features;       // [N, S] or null
    const float* log_scales;     // [N, 3] of ellipsoids, null for spheres
    const float* rotations;      // [N, 4] quaternions wxyz of any length > 0
    const float* harmonics;      // [N, K, 3] coefficients of the degrees 1 to 3, or null
    int feature_channels;        // S
    int harmonic_count;          // K: 0, 3, 8 or 15
    bool centres;                // composite the means as three additional channels after the features
    int extra_channels() const { return feature_channels + (centres ? 3 : 0); }
    Shape shape() const { return log_scales ? Shape::ELLIPSOID : Shape::SPHERE; }
};

// Convolution of the projected Gaussians with a Gaussian, so that none is smaller than a pixel.
struct LowPass {
    float variance = 0.0f;     // squared pixels; 0 for none
    bool compensated = false;  // reduce the opacity such that the integral over the image is kept
};

// Results of the forward pass that the backward pass needs.
struct Rasterisation {
    Pinhole camera;
    float R[9], t[3];
    LowPass low_pass;
    Shape shape = Shape::SPHERE;
    int tiles_x = 0, tiles_y = 0;
    Buffer<Splat> splats;              // visible Gaussians, by index in the map
    Buffer<Slope> slopes;              // of ellipsoids, by index in `splats`
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
    float* log_radii;       // [V], of spheres
    float* opacity_logits;  // [V]
    float* colours;         // [V, 3] or null
    float* features;        // [V, S]
    float* log_scales;      // [V, 3], of ellipsoids
    float* rotations;       // [V, 4]
    float* harmonics;       // [V, K, 3]
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
