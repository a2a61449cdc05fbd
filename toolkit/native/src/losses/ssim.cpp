#include "losses/ssim.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/constants.hpp"
#include "common/simd.hpp"

namespace semsplat {
namespace {

enum { WINDOW = SSIM_WINDOW, HALF = WINDOW / 2, STRIP = 32, MARGIN = 16 };

struct GaussianWindow {
    float w[WINDOW];
    GaussianWindow() {
        double total = 0, raw[WINDOW];
        for (int i = 0; i < WINDOW; ++i) total += raw[i] = std::exp(-0.5 * (i - HALF) * (i - HALF) / (SSIM_SIGMA_PX * SSIM_SIGMA_PX));
        for (int i = 0; i < WINDOW; ++i) w[i] = (float)(raw[i] / total);
    }
};
const GaussianWindow WINDOW_WEIGHTS;

// Rows of an image that a strip needs: its own rows and HALF additional ones on both sides.
struct Strip {
    int begin, end;   // rows written
    int first, last;  // rows read
    Strip(int index, int height)
        : begin(index * STRIP),
          end(std::min(height, begin + STRIP)),
          first(std::max(0, begin - HALF)),
          last(std::min(height, end + HALF)) {}
};

// Rows are padded to full vectors, with MARGIN zeros before and after.
struct Layout {
    int width, blocks;
    explicit Layout(int w) : width(w), blocks((w + 15) / 16) {}
    size_t stride() const { return (size_t)blocks * 16 + 2 * MARGIN; }
    int lanes(int block) const { return std::min(16, width - 16 * block); }
};

// Local sums of x, y, x^2, y^2 and x y; in the backward pass, of three derivatives.
enum { X, Y, XX, YY, XY, MAPS };
enum { BY_MEAN, BY_SQUARE, BY_PRODUCT, DERIVATIVES };

struct Scratch {
    std::vector<float> a, b, rows[MAPS];
    explicit Scratch(const Layout& layout) : a(layout.stride()), b(layout.stride()) {
        for (auto& r : rows) r.resize((size_t)(STRIP + 2 * HALF) * layout.blocks * 16);
    }
};

SEMSPLAT_INLINE F16 first_lanes(int count, F16 a) {
    alignas(64) static const float numbers[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return keep(lt(load(numbers), all((float)count)), a);
}

float sum_of(F16 a) {
    float lanes[16], total = 0;
    store(lanes, a);
    for (float lane : lanes) total += lane;
    return total;
}

// Filters the rows of x, y and of their products.
void blur_rows(const float* x, const float* y, const Strip& strip, const Layout& layout, Scratch& s) {
    const float* w = WINDOW_WEIGHTS.w;
    for (int row = strip.first; row < strip.last; ++row) {
        std::copy_n(x + (size_t)row * layout.width, layout.width, s.a.data() + MARGIN);
        std::copy_n(y + (size_t)row * layout.width, layout.width, s.b.data() + MARGIN);
        for (int block = 0; block < layout.blocks; ++block) {
            const float *a = s.a.data() + MARGIN - HALF + 16 * block, *b = s.b.data() + MARGIN - HALF + 16 * block;
            F16 sums[MAPS] = {all(0), all(0), all(0), all(0), all(0)};
            for (int k = 0; k < WINDOW; ++k) {
                const F16 c = all(w[k]), p = load(a + k), q = load(b + k), cp = c * p, cq = c * q;
                sums[X] = sums[X] + cp;
                sums[Y] = sums[Y] + cq;
                sums[XX] = fma(cp, p, sums[XX]);
                sums[YY] = fma(cq, q, sums[YY]);
                sums[XY] = fma(cp, q, sums[XY]);
            }
            const size_t at = ((size_t)(row - strip.first) * layout.blocks + block) * 16;
            for (int map = 0; map < MAPS; ++map) store(s.rows[map].data() + at, sums[map]);
        }
    }
}

// Filters sixteen pixels of row y vertically, from filtered rows.
template <int COUNT>
SEMSPLAT_INLINE void blur_column(const Scratch& s, const Strip& strip, int y, int block, int blocks, F16* sums) {
    for (int map = 0; map < COUNT; ++map) sums[map] = all(0);
    const int from = std::max(strip.first, y - HALF), to = std::min(strip.last, y + HALF + 1);
    for (int k = from; k < to; ++k) {
        const F16 c = all(WINDOW_WEIGHTS.w[k - y + HALF]);
        const size_t at = ((size_t)(k - strip.first) * blocks + block) * 16;
        for (int map = 0; map < COUNT; ++map) sums[map] = fma(c, load(s.rows[map].data() + at), sums[map]);
    }
}

// SSIM of one strip of one channel. Its derivatives with respect to the local mean, square and product
// of x are written to `by` in padded rows. Returns the sum over the strip's pixels.
double compare(const Strip& strip, const Layout& layout, const Scratch& s, float* const by[DERIVATIVES]) {
    const F16 c1 = all(SSIM_K1 * SSIM_K1), c2 = all(SSIM_K2 * SSIM_K2), two = all(2.0f);
    double total = 0;
    for (int row = strip.begin; row < strip.end; ++row) {
        F16 sum = all(0);
        for (int block = 0; block < layout.blocks; ++block) {
            F16 m[MAPS];
            blur_column<MAPS>(s, strip, row, block, layout.blocks, m);
            const F16 mean = m[X] * m[Y], squares = fma(m[X], m[X], m[Y] * m[Y]);
            // SSIM = A B / (D E).
            const F16 A = fma(two, mean, c1), B = fma(two, m[XY] - mean, c2);
            const F16 D = squares + c1, E = m[XX] + m[YY] - squares + c2;
            const F16 by_d = reciprocal(D), by_e = reciprocal(E), inverse = by_d * by_e;
            const F16 value = A * B * inverse;
            const int lanes = layout.lanes(block);
            sum = sum + first_lanes(lanes, value);
            const F16 found[DERIVATIVES] = {
                two * (m[Y] * (B - A) * inverse - m[X] * value * (by_d - by_e)),
                all(0) - value * by_e,
                two * A * inverse,
            };
            const size_t at = row * layout.stride() + MARGIN + 16 * (size_t)block;
            for (int i = 0; i < DERIVATIVES; ++i) store(by[i] + at, first_lanes(lanes, found[i]));
        }
        for (int i = 0; i < DERIVATIVES; ++i) {
            float* const line = by[i] + row * layout.stride();
            store(line, all(0));
            store(line + layout.stride() - MARGIN, all(0));
        }
        total += sum_of(sum);
    }
    return total;
}

// Chain rule through the windows, which are symmetric and therefore self-adjoint, for one strip.
void spread(const float* x, const float* y, float* const by[DERIVATIVES], const Strip& strip, const Layout& layout,
            float weight, Scratch& s, float* gradient) {
    const float* w = WINDOW_WEIGHTS.w;
    for (int row = strip.first; row < strip.last; ++row) {
        for (int block = 0; block < layout.blocks; ++block) {
            const size_t from = row * layout.stride() + MARGIN - HALF + 16 * (size_t)block;
            F16 sums[DERIVATIVES] = {all(0), all(0), all(0)};
            for (int k = 0; k < WINDOW; ++k) {
                const F16 c = all(w[k]);
                for (int i = 0; i < DERIVATIVES; ++i) sums[i] = fma(c, load(by[i] + from + k), sums[i]);
            }
            const size_t at = ((size_t)(row - strip.first) * layout.blocks + block) * 16;
            for (int i = 0; i < DERIVATIVES; ++i) store(s.rows[i].data() + at, sums[i]);
        }
    }
    for (int row = strip.begin; row < strip.end; ++row) {
        for (int block = 0; block < layout.blocks; ++block) {
            F16 sums[DERIVATIVES];
            blur_column<DERIVATIVES>(s, strip, row, block, layout.blocks, sums);
            float lines[DERIVATIVES][16];
            for (int i = 0; i < DERIVATIVES; ++i) store(lines[i], sums[i]);
            const size_t at = (size_t)row * layout.width + 16 * (size_t)block;
            for (int i = 0, lanes = layout.lanes(block); i < lanes; ++i) {
                gradient[at + i] += weight * (lines[BY_MEAN][i] + 2 * x[at + i] * lines[BY_SQUARE][i] +
                                              y[at + i] * lines[BY_PRODUCT][i]);
            }
        }
    }
}

}  // namespace

double ssim(const float* x, const float* y, int channels, int height, int width, float weight, float* gradient) {
    const Layout layout(width);
    const size_t n = (size_t)height * width, padded = height * layout.stride();
    const int strips = (height + STRIP - 1) / STRIP, tasks = strips * channels;
    std::vector<double> sums((size_t)tasks);
    static thread_local std::vector<float> store;
    store.resize(padded * DERIVATIVES * channels);
    float* const maps = store.data();
#pragma omp parallel
    {
        Scratch scratch(layout);
        const auto by = [&](int channel, float* found[DERIVATIVES]) {
            for (int i = 0; i < DERIVATIVES; ++i) found[i] = maps + (DERIVATIVES * channel + i) * padded;
        };
        float* found[DERIVATIVES];
#pragma omp for schedule(dynamic, 1)
        for (int task = 0; task < tasks; ++task) {
            const int c = task / strips;
            const Strip strip(task % strips, height);
            by(c, found);
            blur_rows(x + c * n, y + c * n, strip, layout, scratch);
            sums[(size_t)task] = compare(strip, layout, scratch, found);
        }
#pragma omp for schedule(dynamic, 1)
        for (int task = 0; task < (gradient ? tasks : 0); ++task) {
            const int c = task / strips;
            by(c, found);
            spread(x + c * n, y + c * n, found, Strip(task % strips, height), layout, weight, scratch,
                   gradient + c * n);
        }
    }
    double total = 0;
    for (double s : sums) total += s;
    return total / ((double)n * channels);
}

}  // namespace semsplat
