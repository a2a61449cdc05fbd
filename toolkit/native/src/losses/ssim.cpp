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
    int width, vectors;
    explicit Layout(int w) : width(w), vectors((w + LANES - 1) / LANES) {}
    size_t padded_width() const { return (size_t)vectors * LANES; }
    size_t stride() const { return padded_width() + 2 * MARGIN; }
    int lanes(int vector) const { return std::min<int>(LANES, width - LANES * vector); }
};

// Local sums of x, y, x^2, y^2 and x y; in the backward pass, of three derivatives.
enum { X, Y, XX, YY, XY, MAPS };
enum { BY_MEAN, BY_SQUARE, BY_PRODUCT, DERIVATIVES };

struct Scratch {
    std::vector<float> a, b, rows[MAPS];
    explicit Scratch(const Layout& layout) : a(layout.stride()), b(layout.stride()) {
        for (auto& r : rows) r.resize((STRIP + 2 * HALF) * layout.padded_width());
    }
};

SEMSPLAT_INLINE Floats first_lanes(int count, Floats a) {
    alignas(64) static const float numbers[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return keep(lt(load(numbers), all((float)count)), a);
}

float sum_of(Floats a) {
    float lanes[LANES], total = 0;
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
        for (int vector = 0; vector < layout.vectors; ++vector) {
            const float *a = s.a.data() + MARGIN - HALF + LANES * vector, *b = s.b.data() + MARGIN - HALF + LANES * vector;
            Floats sums[MAPS] = {all(0), all(0), all(0), all(0), all(0)};
            for (int k = 0; k < WINDOW; ++k) {
                const Floats c = all(w[k]), p = load(a + k), q = load(b + k), cp = c * p, cq = c * q;
                sums[X] = sums[X] + cp;
                sums[Y] = sums[Y] + cq;
                sums[XX] = fma(cp, p, sums[XX]);
                sums[YY] = fma(cq, q, sums[YY]);
                sums[XY] = fma(cp, q, sums[XY]);
            }
            const size_t at = (row - strip.first) * layout.padded_width() + LANES * (size_t)vector;
            for (int map = 0; map < MAPS; ++map) store(s.rows[map].data() + at, sums[map]);
        }
    }
}

// Filters one vector of pixels of row y vertically, from filtered rows.
template <int COUNT>
SEMSPLAT_INLINE void blur_column(const Scratch& s, const Strip& strip, int y, int vector, const Layout& layout, Floats* sums) {
    for (int map = 0; map < COUNT; ++map) sums[map] = all(0);
    const int from = std::max(strip.first, y - HALF), to = std::min(strip.last, y + HALF + 1);
    for (int k = from; k < to; ++k) {
        const Floats c = all(WINDOW_WEIGHTS.w[k - y + HALF]);
        const size_t at = (k - strip.first) * layout.padded_width() + LANES * (size_t)vector;
        for (int map = 0; map < COUNT; ++map) sums[map] = fma(c, load(s.rows[map].data() + at), sums[map]);
    }
}

// SSIM of one strip of one channel. Its derivatives with respect to the local mean, square and product
// of x are written to `by` in padded rows. Returns the sum over the strip's pixels.
double compare(const Strip& strip, const Layout& layout, const Scratch& s, float* const by[DERIVATIVES]) {
    const Floats c1 = all(SSIM_K1 * SSIM_K1), c2 = all(SSIM_K2 * SSIM_K2), two = all(2.0f);
    double total = 0;
    for (int row = strip.begin; row < strip.end; ++row) {
        Floats sum = all(0);
        for (int vector = 0; vector < layout.vectors; ++vector) {
            Floats m[MAPS];
            blur_column<MAPS>(s, strip, row, vector, layout, m);
            const Floats mean = m[X] * m[Y], squares = fma(m[X], m[X], m[Y] * m[Y]);
            // SSIM = A B / (D E).
            const Floats A = fma(two, mean, c1), B = fma(two, m[XY] - mean, c2);
            const Floats D = squares + c1, E = m[XX] + m[YY] - squares + c2;
            const Floats by_d = reciprocal(D), by_e = reciprocal(E), inverse = by_d * by_e;
            const Floats value = A * B * inverse;
            const int lanes = layout.lanes(vector);
            sum = sum + first_lanes(lanes, value);
            const Floats found[DERIVATIVES] = {
                two * (m[Y] * (B - A) * inverse - m[X] * value * (by_d - by_e)),
                all(0) - value * by_e,
                two * A * inverse,
            };
            const size_t at = row * layout.stride() + MARGIN + LANES * (size_t)vector;
            for (int i = 0; i < DERIVATIVES; ++i) store(by[i] + at, first_lanes(lanes, found[i]));
        }
        for (int i = 0; i < DERIVATIVES; ++i) {
            float* const line = by[i] + row * layout.stride();
            std::fill_n(line, (int)MARGIN, 0.0f);
            std::fill_n(line + layout.stride() - MARGIN, (int)MARGIN, 0.0f);
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
        for (int vector = 0; vector < layout.vectors; ++vector) {
            const size_t from = row * layout.stride() + MARGIN - HALF + LANES * (size_t)vector;
            Floats sums[DERIVATIVES] = {all(0), all(0), all(0)};
            for (int k = 0; k < WINDOW; ++k) {
                const Floats c = all(w[k]);
                for (int i = 0; i < DERIVATIVES; ++i) sums[i] = fma(c, load(by[i] + from + k), sums[i]);
            }
            const size_t at = (row - strip.first) * layout.padded_width() + LANES * (size_t)vector;
            for (int i = 0; i < DERIVATIVES; ++i) store(s.rows[i].data() + at, sums[i]);
        }
    }
    for (int row = strip.begin; row < strip.end; ++row) {
        for (int vector = 0; vector < layout.vectors; ++vector) {
            Floats sums[DERIVATIVES];
            blur_column<DERIVATIVES>(s, strip, row, vector, layout, sums);
            float lines[DERIVATIVES][LANES];
            for (int i = 0; i < DERIVATIVES; ++i) store(lines[i], sums[i]);
            const size_t at = (size_t)row * layout.width + LANES * (size_t)vector;
            for (int i = 0, lanes = layout.lanes(vector); i < lanes; ++i) {
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
