// The cost of a pixel and a plane is 1 - ZNCC over a window, averaged over the two best sources, because a
// surface is often hidden in some of them (plane sweep: Collins 1996).
//
// Tiles keep all buffers in the cache nearest to the processor, and what they need of the sources in the
// next one, because the image of a tile in a source moves little from plane to plane.

#include <algorithm>
#include <cmath>

#include "common/simd.hpp"
#include "plane_sweep/costs.hpp"

namespace semsplat {
namespace {

enum {
    RADIUS = 3,  // of the window
    WINDOW = 2 * RADIUS + 1,
    // Largest size of a tile: without and with margin, the latter a multiple of LANES.
    ROWS = 48,
    WIDE_ROWS = ROWS + 2 * RADIUS,
    WIDE = 160,
    COLUMNS = WIDE - 2 * RADIUS,
    BUFFER = ROWS * WIDE,                 // of an image without margin above and below
    WIDE_BUFFER = WIDE_ROWS * WIDE + 16,  // windows of the last columns, which are not used, end behind it
};
constexpr float SHARE = 1.0f / (WINDOW * WINDOW);
// Added to the variances of windows: lower contrast is noise (standard deviation 0.004).
constexpr float NOISE_VARIANCE = 1.6e-5f;
constexpr float NO_CORRELATION = -2.0f;

// The four taps of bilinear interpolation of each pixel, side by side.
std::unique_ptr<float[]> taps_of(const float* image, int width, int height) {
    std::unique_ptr<float[]> taps(new float[4 * (size_t)width * height]);
    for (int y = 0; y < height; ++y) {
        const float* row = image + (size_t)y * width;
        const float* below = image + (size_t)std::min(y + 1, height - 1) * width;
        float* out = &taps[4 * (size_t)y * width];
        for (int x = 0; x < width; ++x, out += 4) {
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

// Buffers of a tile. Those with margin have RADIUS more rows and columns on each side.
struct Tile {
    int first_x, first_y, rows, columns;
    int wide;            // columns with margin, rounded up to a multiple of LANES
    float column[WIDE];  // of the image; margins outside it repeat its border
    float reference[WIDE_BUFFER], first[WIDE_BUFFER], warped[WIDE_BUFFER];
    float mean[BUFFER], inverse_deviation[BUFFER];  // of the reference image in windows
    float inside[BUFFER + 16];                      // whether the source shows the pixel
    float best[BUFFER], second[BUFFER];             // correlations
    float sums[3][WIDE + 16];                       // over the rows of windows
    uint8_t levels[PLANE_BLOCK][BUFFER];            // costs
};

// Sums over the rows of the windows around a row: of the image, its squares, and its products with the
// reference image. From those of the previous row, unless it is the tile's first.
SEMSPLAT_INLINE void sum_rows(Tile& t, const float* image, int row) {
    for (int x = 0; x < t.wide; x += LANES) {
        const float *p = image + row * WIDE + x, *r = t.reference + row * WIDE + x;
        Floats a, b, c;
        if (row == 0) {
            a = b = c = all(0.0f);
            for (int k = 0; k < WINDOW; ++k) {
                const Floats value = load(p + k * WIDE), other = load(r + k * WIDE);
                a = a + value;
                b = fma(value, value, b);
                c = fma(value, other, c);
            }
        } else {
            const Floats left = load(p - WIDE), left_other = load(r - WIDE);
            const Floats value = load(p + (WINDOW - 1) * WIDE), other = load(r + (WINDOW - 1) * WIDE);
            a = load(t.sums[0] + x) + (value - left);
            b = fma(value, value, fnma(left, left, load(t.sums[1] + x)));
            c = fma(value, other, fnma(left, left_other, load(t.sums[2] + x)));
        }
        store(t.sums[0] + x, a);
        store(t.sums[1] + x, b);
        store(t.sums[2] + x, c);
    }
}

SEMSPLAT_INLINE Floats sum_window(const float* sums) {
    const Floats a = load(sums) + load(sums + 1), b = load(sums + 2) + load(sums + 3);
    return (a + b) + ((load(sums + 4) + load(sums + 5)) + load(sums + 6));
}

void load_reference(const Sweep& s, Tile& t) {
    const int width = s.camera.width, height = s.camera.height;
    for (int i = 0; i < t.wide; ++i) t.column[i] = (float)std::min(std::max(t.first_x + i - RADIUS, 0), width - 1);
    for (int row = 0; row < t.rows + 2 * RADIUS; ++row) {
        const int y = std::min(std::max(t.first_y + row - RADIUS, 0), height - 1);
        for (int i = 0; i < t.wide; ++i) {
            const size_t pixel = (size_t)y * width + (int)t.column[i];
            t.reference[row * WIDE + i] = s.intensity[pixel];
            t.first[row * WIDE + i] = s.first[pixel];
        }
    }
    for (int row = 0; row < t.rows; ++row) {
        sum_rows(t, t.reference, row);
        for (int x = 0; x < t.wide; x += LANES) {
            const Floats m = sum_window(t.sums[0] + x) * all(SHARE);
            const Floats variance = maximum(fnma(m, m, sum_window(t.sums[1] + x) * all(SHARE)), all(0.0f));
            store(t.mean + row * WIDE + x, m);
            store(t.inverse_deviation + row * WIDE + x, reciprocal(square_root(variance + all(NOISE_VARIANCE))));
        }
    }
}

// The source's image on a plane; it shows what is at most half a pixel outside. False if it shows no pixel
// of the tile.
bool warp(const Sweep& s, const Warp& w, const float* taps, float offset, Tile& t) {
    const int width = s.camera.width, height = s.camera.height;
    const Floats last_x = all((float)(width - 1)), last_y = all((float)(height - 1));
    uint32_t any = 0;
    for (int row = 0; row < t.rows + 2 * RADIUS; ++row) {
        const float y = (float)std::min(std::max(t.first_y + row - RADIUS, 0), height - 1);
        Floats start[3];
        for (int i = 0; i < 3; ++i) start[i] = all(w.M[3 * i + 1] * y + w.M[3 * i + 2]);
        for (int x = 0; x < t.wide; x += LANES) {
            const Floats column = load(t.column + x), q = load(t.first + row * WIDE + x) + all(offset);
            Floats z = fma(q, all(w.e[2]), fma(column, all(w.M[6]), start[2]));
            const Mask in_front = lt(all(1e-6f), z);
            z = reciprocal(select(in_front, z, all(1.0f)));
            const Floats u = fma(q, all(w.e[0]), fma(column, all(w.M[0]), start[0])) * z;
            const Floats v = fma(q, all(w.e[1]), fma(column, all(w.M[3]), start[1])) * z;
            const Floats cu = minimum(maximum(u, all(0.0f)), last_x), cv = minimum(maximum(v, all(0.0f)), last_y);
            const Floats left = truncate(cu), top = truncate(cv), a = cu - left, b = cv - top;
            float lefts[LANES], tops[LANES];
            store(lefts, left);
            store(tops, top);
            int32_t index[LANES];
            for (int i = 0; i < LANES; ++i) index[i] = (int32_t)tops[i] * width + (int32_t)lefts[i];
            Floats tap[4];
            gather4(taps, index, tap);
            const Floats upper = fma(a, tap[1] - tap[0], tap[0]), lower = fma(a, tap[3] - tap[2], tap[2]);
            store(t.warped + row * WIDE + x, fma(b, lower - upper, upper));
            if (row >= RADIUS && row < RADIUS + t.rows) {
                const Mask across = lt(maximum(u - cu, cu - u), all(0.5f)), down = lt(maximum(v - cv, cv - v), all(0.5f));
                const Mask seen = both(in_front, both(across, down));
                any |= bits(seen);
                store(t.inside + (row - RADIUS) * WIDE + x, keep(seen, all(1.0f)));
            }
        }
    }
    return any != 0;
}

void correlate(Tile& t) {
    for (int row = 0; row < t.rows; ++row) {
        sum_rows(t, t.warped, row);
        // Windows and masks of a pixel begin at its column in the buffers with margin.
        const float *mean = t.mean + row * WIDE, *inverse_deviation = t.inverse_deviation + row * WIDE;
        const float* inside = t.inside + row * WIDE + RADIUS;
        float *best = t.best + row * WIDE, *second = t.second + row * WIDE;
        for (int x = 0; x < t.wide; x += LANES) {
            const Floats m = sum_window(t.sums[0] + x) * all(SHARE);
            const Floats variance =
                maximum(fnma(m, m, sum_window(t.sums[1] + x) * all(SHARE)), all(0.0f)) + all(NOISE_VARIANCE);
            const Floats covariance = fnma(m, load(mean + x), sum_window(t.sums[2] + x) * all(SHARE));
            Floats zncc = covariance * load(inverse_deviation + x) * reciprocal(square_root(variance));
            zncc = select(lt(all(0.5f), load(inside + x)), zncc, all(NO_CORRELATION));
            const Floats first = load(best + x);
            store(second + x, maximum(load(second + x), minimum(first, zncc)));
            store(best + x, maximum(first, zncc));
        }
    }
}

void store_levels(Tile& t, int slot) {
    const Floats unseen = all(NO_CORRELATION);
    for (int i = 0; i < t.rows * WIDE; i += LANES) {
        const Floats best = load(t.best + i), second = load(t.second + i);
        const Floats zncc = select(lt(unseen, second), all(0.5f) * (best + second), best);
        Floats cost = all((float)MAX_COST) * minimum(maximum(all(1.0f) - zncc, all(0.0f)), all(1.0f));
        cost = select(lt(unseen, best), cost, all((float)UNKNOWN_COST));
        float rounded[LANES];
        store(rounded, cost + all(0.5f));
        for (int k = 0; k < LANES; ++k) t.levels[slot][i + k] = (uint8_t)(int32_t)rounded[k];
    }
}

int count_of(int length, int part) { return (length + part - 1) / part; }

}  // namespace

struct Matching::Images {
    std::vector<std::unique_ptr<float[]>> taps;
    std::vector<Warp> warps;
};

Matching::Matching(const Sweep& sweep, CostVolume& volume) : s(sweep), costs(volume) {
    std::unique_ptr<Images> prepared(new Images);
    for (const SweepSource& source : sweep.sources) {
        prepared->taps.push_back(taps_of(source.intensity, s.camera.width, s.camera.height));
        prepared->warps.emplace_back(s.camera, source.T_source_reference);
    }
    images = std::move(prepared);
}

Matching::~Matching() = default;

int Matching::tiles() const { return count_of(s.camera.width, COLUMNS) * count_of(s.camera.height, ROWS); }

void Matching::compute(int tile) const {
    const std::unique_ptr<Tile> buffers(new Tile);
    Tile& t = *buffers;
    const int width = s.camera.width, height = s.camera.height;
    const int across = count_of(width, COLUMNS), down = count_of(height, ROWS);
    // Tiles of similar size; their margins are computed twice.
    t.first_x = tile % across * width / across;
    t.columns = (tile % across + 1) * width / across - t.first_x;
    t.first_y = tile / across * height / down;
    t.rows = (tile / across + 1) * height / down - t.first_y;
    t.wide = (t.columns + 2 * RADIUS + LANES - 1) / LANES * LANES;
    load_reference(s, t);
    for (int block = 0; block < costs.stride; block += PLANE_BLOCK) {
        for (int slot = 0; slot < PLANE_BLOCK; ++slot) {
            if (block + slot >= s.planes) {
                std::fill_n(t.levels[slot], (int)BUFFER, (uint8_t)MAX_COST);
                continue;
            }
            std::fill_n(t.best, (int)BUFFER, NO_CORRELATION);
            std::fill_n(t.second, (int)BUFFER, NO_CORRELATION);
            const float offset = (float)((block + slot) * s.step);
            for (size_t k = 0; k < images->taps.size(); ++k) {
                if (warp(s, images->warps[k], images->taps[k].get(), offset, t)) correlate(t);
            }
            store_levels(t, slot);
        }
        for (int row = 0; row < t.rows; ++row) {
            uint8_t* out = costs.at(t.first_x, t.first_y + row) + block;
            for (int slot = 0; slot < PLANE_BLOCK; ++slot) {
                const uint8_t* from = t.levels[slot] + row * WIDE;
                for (int x = 0; x < t.columns; ++x) out[(size_t)x * costs.stride + slot] = from[x];
            }
        }
    }
}

}  // namespace semsplat
