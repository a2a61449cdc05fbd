// Surfaces that two keyframes have in common.
#pragma once

#include <cstdint>

#include "common/camera.hpp"

namespace semsplat {

// An earlier image, divided into cells of size x size pixels.
//   depth: [H, W] m, 0 where missing
struct CellImage {
    Pinhole camera;
    const float* depth;
    int size;
};

struct SameSurface {
    double max_difference;  // of the depths, as a fraction
    double min_cosine;      // of the angle at which the cameras see a point
};

// For points [count, 3] in the coordinates of a newer camera, finds the row-major numbers of the cells of the
// earlier image that measured the same surface, or -1. T_old_new: [3, 4].
void find_common_cells(const double* points, int64_t count, const double* T_old_new, const CellImage& old,
                       const SameSurface& limits, int32_t* cells);

}  // namespace semsplat
