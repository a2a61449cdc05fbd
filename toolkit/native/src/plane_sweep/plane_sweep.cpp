// Plane sweep with semi-global matching (Collins 1996; Hirschmueller 2008).
//
// Each plane of constant depth maps the source images onto the reference image. The cost of a pixel
// and a plane is 1 - ZNCC over a window, averaged over the two best sources, because a surface is often
// hidden in some of them. Four paths of semi-global matching make the depth piecewise smooth.
//
// Every pixel's result is computed in the same order whatever the number of threads.
#include "plane_sweep/plane_sweep.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include "common/simd.hpp"

namespace semsplat {
namespace {

enum {
    RADIUS = 3,  // of the window
    WINDOW = 2 * RADIUS + 1,
    STRIP = 16,    // rows whose costs are computed together
    COLUMNS = 16,  // columns whose vertical paths are followed together
    MAX_COST = 255,
    // Cost of planes that no source shows: neither good nor bad.
    UNKNOWN_COST = 128,
};
// Added to the variances of windows: lower contrast is noise (standard deviation 0.004).
constexpr float NOISE_VARIANCE = 1.6e-5f;
// Intensity difference to the previous pixel at which a depth discontinuity costs half as much.
constexpr float EDGE_CONTRAST = 0.04f;
constexpr float NO_CORRELATION = -2.0f;

typedef std::vector<float> Row;

// The four taps of bilinear interpolation of each pixel, side by side.
std::vector<float> taps_of(const float* image, int width, int height) {
    std::vector<float> taps(4 * (size_t)width * height);
    for (int y = 0; y < height; ++y) {
        const float* row = image + (size_t)y * width;
        const float* below = image + (size_t)std::min(y + 1, height - 1) * width;
        for (int x = 0; x < width; ++x) {
            float* out = &taps[4 * ((size_t)y * width + x)];
            const int right = std::min(x + 1, width - 1);
            out[0] = row[x];
            out[1] = row[right];
            out[2] = below[x];
            out[3] = below[right];
        }
    }
    return taps;
}

// Maps pixels of the reference image at an inverse depth q to a source: M (x, y, 1) + q e.
struct Warp {
    float M[9], e[3];

    Warp(const Pinhole& c, const std::array<double, 12>& T) {
        const double K[2][3] = {{c.fx, 0, c.cx}, {0, c.fy, c.cy}};
        double KR[9], Kt[3];
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 4; ++j) {
                const double value = i < 2 ? K[i][i] * T[4 * i + j] + K[i][2] * T[8 + j] : T[8 + j];
                (j < 3 ? KR[3 * i + j] : Kt[i]) = value;
            }
        }
        for (int i = 0; i < 3; ++i) {
            M[3 * i] = (float)(KR[3 * i] / c.fx);
            M[3 * i + 1] = (float)(KR[3 * i + 1] / c.fy);
            M[3 * i + 2] = (float)(KR[3 * i + 2] - KR[3 * i] * c.cx / c.fx - KR[3 * i + 1] * c.cy / c.fy);
            e[i] = (float)Kt[i];
        }
    }
};

// Images of a strip of rows, with a margin of RADIUS rows and columns on each side, and their sums over
// windows. Margins outside the image repeat its border.
class Strip {
public:
    Strip(int width) : width(width), stride(padded(width) + 2 * RADIUS + LANES) {
        for (Row* row : {&reference, &warped, &inside}) row->assign((size_t)stride * (STRIP + 2 * RADIUS), 0);
        for (Row* row : {&mean_r, &variance_r, &best, &second}) row->assign((size_t)padded(width) * STRIP, 0);
        for (Row& sums : columns) sums.assign(stride, 0);
    }

    static int padded(int width) { return (width + LANES - 1) / LANES * LANES; }

    float* at(Row& image, int row) { return &image[(size_t)(row + RADIUS) * stride + RADIUS]; }
    float* line(Row& image, int row) { return &image[(size_t)row * padded(width)]; }

    void repeat_border(Row& image) {
        for (int row = -RADIUS; row < STRIP + RADIUS; ++row) {
            float* p = at(image, row);
            for (int k = 1; k <= RADIUS; ++k) p[-k] = p[0];
            for (int k = width; k < stride - RADIUS; ++k) p[k] = p[width - 1];
        }
    }

    int width, stride;
    Row reference, warped, inside;         // with margins
    Row mean_r, variance_r, best, second;  // without
    Row columns[3];                        // sums over the rows of windows
};

// Costs of all planes for a strip of rows, in the order (row, column, plane).
class Matching {
public:
    Matching(const Sweep& sweep, std::vector<uint8_t>& costs) : s(sweep), costs(costs) {
        for (const SweepSource& source : sweep.sources) {
            taps.push_back(taps_of(source.intensity, s.camera.width, s.camera.height));
            warps.emplace_back(s.camera, source.T_source_reference);
        }
    }

    void compute(int first_row, Strip& strip) const {
        const int rows = std::min<int>(STRIP, s.camera.height - first_row);
        load_reference(first_row, rows, strip);
        for (int plane = 0; plane < s.planes; ++plane) {
            const float q = inverse_depth(plane);
            std::fill(strip.best.begin(), strip.best.end(), NO_CORRELATION);
            std::fill(strip.second.begin(), strip.second.end(), NO_CORRELATION);
            for (size_t k = 0; k < taps.size(); ++k) {
                if (warp(k, q, first_row, strip)) correlate(rows, strip);
            }
            store_costs(first_row, rows, plane, strip);
        }
    }

private:
    const Sweep& s;
    std::vector<uint8_t>& costs;
    std::vector<std::vector<float>> taps;
    std::vector<Warp> warps;

    float inverse_depth(int plane) const {
        return (float)(s.min_inverse_depth +
                       plane * (s.max_inverse_depth - s.min_inverse_depth) / std::max(s.planes - 1, 1));
    }

    void load_reference(int first_row, int rows, Strip& strip) const {
        const int width = s.camera.width;
        for (int row = -RADIUS; row < STRIP + RADIUS; ++row) {
            const int y = std::min(std::max(first_row + row, 0), s.camera.height - 1);
            std::copy_n(s.intensity + (size_t)y * width, width, strip.at(strip.reference, row));
        }
        strip.repeat_border(strip.reference);
        constexpr float share = 1.0f / (WINDOW * WINDOW);
        for (int row = 0; row < rows; ++row) {
            sum_columns(strip, row, strip.reference);
            float *mean = strip.line(strip.mean_r, row), *variance = strip.line(strip.variance_r, row);
            for (int x = 0; x < width; x += LANES) {
                Floats sums[3];
                sum_windows(strip, x, sums);
                const Floats m = sums[0] * all(share);
                store(mean + x, m);
                store(variance + x, maximum(fnma(m, m, sums[1] * all(share)), all(0.0f)) + all(NOISE_VARIANCE));
            }
        }
    }

    // The source's image on a plane. False if it does not show any pixel of the strip.
    bool warp(size_t source, float q, int first_row, Strip& strip) const {
        const Warp& w = warps[source];
        const float* image = taps[source].data();
        const int width = s.camera.width, height = s.camera.height;
        const Floats last_x = all((float)(width - 1)), last_y = all((float)(height - 1));
        uint32_t any = 0;
        for (int row = -RADIUS; row < STRIP + RADIUS; ++row) {
            const float y = (float)std::min(std::max(first_row + row, 0), height - 1);
            Floats start[3];
            for (int i = 0; i < 3; ++i) start[i] = all(w.M[3 * i + 1] * y + w.M[3 * i + 2] + q * w.e[i]);
            float* out = strip.at(strip.warped, row);
            float* inside = strip.at(strip.inside, row);
            for (int x = 0; x < width; x += LANES) {
                const Floats column = load(COLUMN_NUMBERS) + all((float)x);
                Floats z = fma(column, all(w.M[6]), start[2]);
                const Mask in_front = lt(all(1e-6f), z);
                z = reciprocal(select(in_front, z, all(1.0f)));
                const Floats u = fma(column, all(w.M[0]), start[0]) * z, v = fma(column, all(w.M[3]), start[1]) * z;
                const Mask low = both(ge(u, all(0.0f)), ge(v, all(0.0f)));
                const Mask high = both(ge(last_x, u), ge(last_y, v));
                const Mask seen = both(in_front, both(low, high));
                any |= bits(seen);
                const Floats cu = minimum(maximum(u, all(0.0f)), last_x), cv = minimum(maximum(v, all(0.0f)), last_y);
                const Floats left = truncate(cu), top = truncate(cv), a = cu - left, b = cv - top;
                float lefts[LANES], tops[LANES];
                store(lefts, left);
                store(tops, top);
                int32_t index[LANES];
                for (int i = 0; i < LANES; ++i) index[i] = (int32_t)tops[i] * width + (int32_t)lefts[i];
                Floats tap[4];
                gather4(image, index, tap);
                const Floats upper = fma(a, tap[1] - tap[0], tap[0]), lower = fma(a, tap[3] - tap[2], tap[2]);
                store(out + x, fma(b, lower - upper, upper));
                store(inside + x, keep(seen, all(1.0f)));
            }
        }
        strip.repeat_border(strip.warped);
        return any != 0;
    }

    // Sums over the rows of the windows around a row: of the image, its squares, and its products with
    // the reference image.
    static void sum_columns(Strip& strip, int row, Row& image) {
        const int stride = strip.stride;
        const float* p = strip.at(image, row - RADIUS) - RADIUS;
        const float* r = strip.at(strip.reference, row - RADIUS) - RADIUS;
        float *sum = strip.columns[0].data(), *squares = strip.columns[1].data(), *products = strip.columns[2].data();
        for (int x = 0; x + LANES <= stride; x += LANES) {
            Floats a = all(0.0f), b = a, c = a;
            for (int k = 0; k < WINDOW; ++k) {
                const Floats value = load(p + (size_t)k * stride + x), other = load(r + (size_t)k * stride + x);
                a = a + value;
                b = fma(value, value, b);
                c = fma(value, other, c);
            }
            store(sum + x, a);
            store(squares + x, b);
            store(products + x, c);
        }
    }

    static void sum_windows(const Strip& strip, int x, Floats (&sums)[3]) {
        for (int i = 0; i < 3; ++i) {
            const float* p = strip.columns[i].data() + x;
            sums[i] = load(p);
            for (int k = 1; k < WINDOW; ++k) sums[i] = sums[i] + load(p + k);
        }
    }

    static void correlate(int rows, Strip& strip) {
        const Floats share = all(1.0f / (WINDOW * WINDOW));
        for (int row = 0; row < rows; ++row) {
            sum_columns(strip, row, strip.warped);
            const float *mean = strip.line(strip.mean_r, row), *variance = strip.line(strip.variance_r, row);
            const float* inside = strip.at(strip.inside, row);
            float *best = strip.line(strip.best, row), *second = strip.line(strip.second, row);
            for (int x = 0; x < strip.width; x += LANES) {
                Floats sums[3];
                sum_windows(strip, x, sums);
                const Floats m = sums[0] * share;
                const Floats own = maximum(fnma(m, m, sums[1] * share), all(0.0f)) + all(NOISE_VARIANCE);
                const Floats covariance = fnma(m, load(mean + x), sums[2] * share);
                Floats zncc = covariance * reciprocal(square_root(own * load(variance + x)));
                zncc = select(lt(all(0.5f), load(inside + x)), zncc, all(NO_CORRELATION));
                const Floats first = load(best + x);
                store(second + x, maximum(load(second + x), minimum(first, zncc)));
                store(best + x, maximum(first, zncc));
            }
        }
    }

    void store_costs(int first_row, int rows, int plane, Strip& strip) const {
        for (int row = 0; row < rows; ++row) {
            const float *best = strip.line(strip.best, row), *second = strip.line(strip.second, row);
            uint8_t* out = &costs[((size_t)(first_row + row) * s.camera.width) * s.planes + plane];
            for (int x = 0; x < s.camera.width; ++x) {
                float cost = UNKNOWN_COST;
                if (best[x] > NO_CORRELATION) {
                    const float zncc = second[x] > NO_CORRELATION ? 0.5f * (best[x] + second[x]) : best[x];
                    cost = MAX_COST * std::min(std::max(1 - zncc, 0.0f), 1.0f);
                }
                out[(size_t)x * s.planes] = (uint8_t)(cost + 0.5f);
            }
        }
    }

    static const float COLUMN_NUMBERS[16];
};

const float Matching::COLUMN_NUMBERS[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

// Path costs of one pixel, with a guard on both sides.
struct Path {
    std::vector<uint16_t> values;
    uint16_t least;

    explicit Path(int planes) : values(planes + 2, UINT16_MAX / 2), least(0) {}

    void start(const uint8_t* cost, int planes, uint16_t* total) {
        least = UINT16_MAX;
        for (int d = 0; d < planes; ++d) {
            values[d + 1] = cost[d];
            total[d] = (uint16_t)(total[d] + cost[d]);
            least = std::min(least, values[d + 1]);
        }
    }

    // Continues the path of the previous pixel.
    void step(const Path& last, const uint8_t* cost, int planes, uint16_t p1, uint16_t p2, uint16_t* total) {
        const uint16_t* before = last.values.data() + 1;
        uint16_t* now = values.data() + 1;
        const uint16_t base = last.least, jump = (uint16_t)(base + p2);
        uint16_t minimum = UINT16_MAX;
#pragma omp simd reduction(min : minimum)
        for (int d = 0; d < planes; ++d) {
            const uint16_t side = (uint16_t)(std::min(before[d - 1], before[d + 1]) + p1);
            const uint16_t best = std::min(std::min(before[d], side), jump);
            const uint16_t value = (uint16_t)(cost[d] + best - base);
            now[d] = value;
            total[d] = (uint16_t)(total[d] + value);
            minimum = std::min(minimum, value);
        }
        least = minimum;
    }
};

class Aggregation {
public:
    Aggregation(const Sweep& sweep, const std::vector<uint8_t>& costs, std::vector<uint16_t>& totals)
        : s(sweep), costs(costs), totals(totals), p1((uint16_t)std::lround(MAX_COST * sweep.step_penalty)) {}

    void along_row(int y) {
        Path now(s.planes), last(s.planes);
        for (const int direction : {1, -1}) {
            const int begin = direction > 0 ? 0 : s.camera.width - 1;
            last.start(cost(begin, y), s.planes, total(begin, y));
            for (int x = begin + direction; x >= 0 && x < s.camera.width; x += direction) {
                now.step(last, cost(x, y), s.planes, p1, jump(x, y, x - direction, y), total(x, y));
                std::swap(now, last);
            }
        }
    }

    void along_columns(int first, int last) {
        std::vector<Path> now((size_t)(last - first), Path(s.planes)), before = now;
        for (const int direction : {1, -1}) {
            const int begin = direction > 0 ? 0 : s.camera.height - 1;
            for (int x = first; x < last; ++x) before[x - first].start(cost(x, begin), s.planes, total(x, begin));
            for (int y = begin + direction; y >= 0 && y < s.camera.height; y += direction) {
                for (int x = first; x < last; ++x) {
                    now[x - first].step(before[x - first], cost(x, y), s.planes, p1, jump(x, y, x, y - direction),
                                        total(x, y));
                }
                std::swap(now, before);
            }
        }
    }

private:
    const Sweep& s;
    const std::vector<uint8_t>& costs;
    std::vector<uint16_t>& totals;
    uint16_t p1;

    size_t at(int x, int y) const { return ((size_t)y * s.camera.width + x) * s.planes; }
    const uint8_t* cost(int x, int y) const { return &costs[at(x, y)]; }
    uint16_t* total(int x, int y) const { return &totals[at(x, y)]; }

    // Penalty of a discontinuity between two pixels: depth often changes where intensity does.
    uint16_t jump(int x, int y, int last_x, int last_y) const {
        const int width = s.camera.width;
        const float contrast =
            std::fabs(s.intensity[(size_t)y * width + x] - s.intensity[(size_t)last_y * width + last_x]);
        const double penalty = MAX_COST * s.jump_penalty / (1 + contrast / EDGE_CONTRAST);
        return (uint16_t)std::max<long>(std::lround(penalty), p1);
    }
};

void choose(const Sweep& s, const uint8_t* cost, const uint16_t* total, size_t pixel, const SweepResult& out) {
    int best = 0;
    for (int d = 1; d < s.planes; ++d) {
        if (total[d] < total[best]) best = d;
    }
    int other = UINT16_MAX;
    for (int d = 0; d < s.planes; ++d) {
        if (std::abs(d - best) > 1) other = std::min<int>(other, total[d]);
    }
    out.correlation[pixel] = 1.0f - cost[best] / (float)MAX_COST;
    out.margin[pixel] = std::min((float)(other - total[best]) / (4.0f * MAX_COST), 1.0f);
    // The surface may be nearer than the last plane.
    const bool found = best < s.planes - 1 && cost[best] != UNKNOWN_COST;
    double place = best;
    if (best > 0 && best < s.planes - 1) {
        const int curvature = total[best - 1] - 2 * total[best] + total[best + 1];
        if (curvature > 0) place += 0.5 * (total[best - 1] - total[best + 1]) / curvature;
    }
    const double step = (s.max_inverse_depth - s.min_inverse_depth) / std::max(s.planes - 1, 1);
    out.inverse_depth[pixel] = found ? (float)(s.min_inverse_depth + place * step) : 0.0f;
}

}  // namespace

void sweep(const Sweep& s, const SweepResult& result) {
    const int width = s.camera.width, height = s.camera.height;
    std::vector<uint8_t> costs((size_t)width * height * s.planes);
    std::vector<uint16_t> totals(costs.size());
    const Matching matching(s, costs);
    Aggregation aggregation(s, costs, totals);
#pragma omp parallel
    {
        Strip strip(width);
#pragma omp for schedule(dynamic)
        for (int row = 0; row < height; row += STRIP) matching.compute(row, strip);
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) aggregation.along_row(y);
#pragma omp for schedule(dynamic)
        for (int x = 0; x < width; x += COLUMNS) aggregation.along_columns(x, std::min<int>(x + COLUMNS, width));
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) {
            for (int x = 0; x < width; ++x) {
                const size_t pixel = (size_t)y * width + x;
                choose(s, &costs[pixel * s.planes], &totals[pixel * s.planes], pixel, result);
            }
        }
    }
}

}  // namespace semsplat
