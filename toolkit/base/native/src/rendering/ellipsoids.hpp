// Projection of ellipsoids with view-dependent colours, and its chain rule.
#pragma once

#include "rendering/splats.hpp"

namespace semsplat {

// Sums over the pixels of one splat for the backward pass: e = alpha dL/dalpha, its moments, and the
// gradients of the first channels. Spheres have the moments of dx and dy, and that of dx^2 + dy^2;
// ellipsoids have those of s = shape_a dx + shape_b dy and t = shape_c dy, with more of them at MIXED,
// where those of the depth's gradient follow.
enum { E, E_DX, E_DY, E_SQUARE, GRAD_R, GRAD_G, GRAD_B, GRAD_Z, MIXED, MAX_SUMS = 12 };
enum { E_S = E_DX, E_T = E_DY, E_S_S = E_SQUARE, E_S_T = 0, E_T_T, Z_S, Z_T };
constexpr int sums_of(Shape shape) { return shape == Shape::SPHERE ? (int)MIXED : (int)MAX_SUMS; }

// Writes the Gaussian with index i of the map as a splat; false if it is invisible.
bool project_ellipsoid(const Gaussians& map, const Rasterisation& state, int64_t i, Splat& splat, Slope& slope);

// Writes the gradients of the splat with index i, and adds its contribution to that of the pose [3, 4].
void differentiate_ellipsoid(const Gaussians& map, const Rasterisation& state, int64_t i, const float* sums,
                             const GradientSinks& out, double* pose);

}  // namespace semsplat
