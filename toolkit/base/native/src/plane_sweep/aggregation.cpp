// Four paths of semi-global matching make the depth piecewise smooth (Hirschmueller 2008).

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "common/simd.hpp"
#include "plane_sweep/costs.hpp"

namespace semsplat {
namespace {

enum {
    // Paths that are followed together: their steps do not wait for each other.
    ROWS = 4,
    COLUMNS = 16,
    VECTOR = PLANE_BLOCK,
    HIGH = INT16_MAX,  // above all costs of paths, and twice of it is below UINT16_MAX
};
// Intensity difference to the previous pixel at which a depth discontinuity costs half as much.
constexpr float EDGE_CONTRAST = 0.04f;

typedef uint8_t Bytes __attribute__((vector_size(VECTOR)));
typedef uint16_t Shorts __attribute__((vector_size(2 * VECTOR)));

SEMSPLAT_INLINE void load_bytes(const uint8_t* p, Shorts& a) {
    Bytes bytes;
    std::memcpy(&bytes, p, sizeof bytes);
    a = __builtin_convertvector(bytes, Shorts);
}
SEMSPLAT_INLINE void load_shorts(const uint16_t* p, Shorts& a) { std::memcpy(&a, p, sizeof a); }
SEMSPLAT_INLINE void store_shorts(uint16_t* p, const Shorts& a) { std::memcpy(p, &a, sizeof a); }
SEMSPLAT_INLINE void lower(Shorts& a, const Shorts& b) { a = a < b ? a : b; }
// The least element in all lanes.
SEMSPLAT_INLINE void spread_least(Shorts& a) {
    lower(a, __builtin_shufflevector(a, a, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7));
    lower(a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11));
    lower(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13));
    lower(a, __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14));
}

// Path costs of the last pixel, and the least of them.
struct Path {
    std::vector<uint16_t> values;
    uint16_t least;

    explicit Path(int stride) : values((size_t)stride), least(0) {}

    // Continues the path at a pixel; the first pixel of a path is continued from zeros.
    template <bool FIRST>
    SEMSPLAT_INLINE void step(const uint8_t* cost, int stride, uint16_t p1, uint16_t p2, uint16_t* total) {
        const Shorts step = Shorts{} + p1, base = Shorts{} + least, jump = Shorts{} + (uint16_t)(least + p2);
        Shorts minimum = Shorts{} + (uint16_t)HIGH, before = minimum, here;
        load_shorts(values.data(), here);
        for (int d = 0; d < stride; d += VECTOR) {
            Shorts after = Shorts{} + (uint16_t)HIGH;
            if (d + VECTOR < stride) load_shorts(&values[d + VECTOR], after);
            Shorts side = __builtin_shufflevector(before, here, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
            lower(side, __builtin_shufflevector(here, after, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16));
            Shorts best = side + step;
            lower(best, here);
            lower(best, jump);
            Shorts value;
            load_bytes(cost + d, value);
            value += best - base;
            store_shorts(&values[d], value);
            Shorts sum = value;
            if (!FIRST) {
                load_shorts(total + d, sum);
                sum += value;
            }
            store_shorts(total + d, sum);
            lower(minimum, value);
            before = here;
            here = after;
        }
        spread_least(minimum);
        least = minimum[0];
    }
};

int count_of(int length, int part) { return (length + part - 1) / part; }

}  // namespace

Aggregation::Aggregation(const Sweep& sweep, const CostVolume& volume, const SweepResult& out)
    : s(sweep), costs(volume), result(out), p1((uint16_t)std::lround(MAX_COST * sweep.step_penalty)),
      totals(new uint16_t[(size_t)volume.width * volume.height * volume.stride]) {}

int Aggregation::row_groups() const { return count_of(costs.height, ROWS); }
int Aggregation::column_groups() const { return count_of(costs.width, COLUMNS); }

uint16_t* Aggregation::total(int x, int y) const { return &totals[((size_t)y * costs.width + x) * costs.stride]; }

// Penalty of a discontinuity between two pixels: depth often changes where intensity does.
uint16_t Aggregation::jump(int x, int y, int last_x, int last_y) const {
    const float contrast =
        std::fabs(s.intensity[(size_t)y * costs.width + x] - s.intensity[(size_t)last_y * costs.width + last_x]);
    const float penalty = MAX_COST * (float)s.jump_penalty / (1 + contrast / EDGE_CONTRAST);
    return std::max((uint16_t)(int)(penalty + 0.5f), p1);
}

void Aggregation::along_rows(int group) {
    const int first = group * ROWS, last = std::min<int>(first + ROWS, costs.height), width = costs.width;
    for (const int direction : {1, -1}) {
        std::vector<Path> paths((size_t)(last - first), Path(costs.stride));
        for (int i = 0; i < width; ++i) {
            const int x = direction > 0 ? i : width - 1 - i, before = i ? x - direction : x;
            for (int y = first; y < last; ++y) {
                Path& path = paths[(size_t)(y - first)];
                const uint16_t p2 = jump(x, y, before, y);
                if (direction > 0) {
                    path.step<true>(costs.at(x, y), costs.stride, p1, p2, total(x, y));
                } else {
                    path.step<false>(costs.at(x, y), costs.stride, p1, p2, total(x, y));
                }
            }
        }
    }
}

void Aggregation::along_columns_and_choose(int group) {
    const int first = group * COLUMNS, last = std::min<int>(first + COLUMNS, costs.width), height = costs.height;
    for (const int direction : {1, -1}) {
        std::vector<Path> paths((size_t)(last - first), Path(costs.stride));
        for (int i = 0; i < height; ++i) {
            const int y = direction > 0 ? i : height - 1 - i, before = i ? y - direction : y;
            for (int x = first; x < last; ++x) {
                const uint16_t p2 = jump(x, y, x, before);
                paths[(size_t)(x - first)].step<false>(costs.at(x, y), costs.stride, p1, p2, total(x, y));
                if (direction < 0) choose(x, y);
            }
        }
    }
}

void Aggregation::choose(int x, int y) const {
    const uint8_t* cost = costs.at(x, y);
    const uint16_t* sums = total(x, y);
    const size_t pixel = (size_t)y * costs.width + x;
    uint16_t least = UINT16_MAX;
    for (int d = 0; d < costs.stride; ++d) least = std::min(least, sums[d]);
    int best = 0;
    while (best < s.planes - 1 && sums[best] > least) ++best;
    // The best of the planes that are not beside it.
    uint16_t other = UINT16_MAX;
    for (int d = 0; d < best - 1; ++d) other = std::min(other, sums[d]);
    for (int d = best + 2; d < s.planes; ++d) other = std::min(other, sums[d]);
    float place = (float)best;
    if (best > 0 && best < s.planes - 1) {
        const int curvature = sums[best - 1] - 2 * sums[best] + sums[best + 1];
        if (curvature > 0) place += 0.5f * (float)(sums[best - 1] - sums[best + 1]) / (float)curvature;
    }
    result.correlation[pixel] = 1.0f - cost[best] / (float)MAX_COST;
    result.margin[pixel] = std::min((float)(other - least) / (4.0f * MAX_COST), 1.0f);
    result.plane[pixel] = cost[best] == UNKNOWN_COST ? -1.0f : place;
}

}  // namespace semsplat
