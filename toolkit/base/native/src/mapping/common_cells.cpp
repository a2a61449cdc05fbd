#include "mapping/common_cells.hpp"

#include <algorithm>
#include <cmath>

namespace semsplat {

void find_common_cells(const double* points, int64_t count, const double* T_old_new, const CellImage& old,
                       const SameSurface& limits, int32_t* cells) {
    const double* T = T_old_new;
    const Pinhole& camera = old.camera;
    const int columns = camera.width / old.size, rows = camera.height / old.size;
    for (int64_t i = 0; i < count; ++i) {
        const double* p = points + 3 * i;
        cells[i] = -1;
        const double x = T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3];
        const double y = T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7];
        const double z = T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11];
        if (!(z > 0)) continue;
        const double u = camera.fx * x / z + camera.cx, v = camera.fy * y / z + camera.cy;
        const double column = std::floor((u + 0.5) / old.size), row = std::floor((v + 0.5) / old.size);
        if (!(column >= 0 && row >= 0 && column < columns && row < rows)) continue;
        const double depth = old.depth[(size_t)std::nearbyint(v) * camera.width + (size_t)std::nearbyint(u)];
        if (!(std::abs(z - depth) < limits.max_difference * depth)) continue;
        const double a = x - T[3], b = y - T[7], c = z - T[11];
        const double lengths = std::sqrt((x * x + y * y + z * z) * (a * a + b * b + c * c));
        if (x * a + y * b + z * c > limits.min_cosine * std::max(lengths, 1e-9)) {
            cells[i] = (int32_t)row * columns + (int32_t)column;
        }
    }
}

}  // namespace semsplat
