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

// Rows of a strip, filtered horizontally. All that one vector of columns needs is contiguous: the rows
// of several maps would not fit into the L1 cache otherwise.
class FilteredRows {
public:
    explicit FilteredRows(const Layout& layout) : values_(ROWS * MAPS * layout.padded_width()) {}
    float* at(int vector, int row) { return values_.data() + ((size_t)vector * ROWS + row) * MAPS * LANES; }
    const float* at(int vector, int row) const {
        return values_.data() + ((size_t)vector * ROWS + row) * MAPS * LANES;
    }

private:
    enum { ROWS = STRIP + 2 * HALF };
    std::vector<float> values_;
};

struct Scratch {
    std::vector<float> a, b;
    FilteredRows rows;
    explicit Scratch(const Layout& layout) : a(layout.stride()), b(layout.stride()), rows(layout) {}
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
            float* const to = s.rows.at(vector, row - strip.first);
            for (int map = 0; map < MAPS; ++map) store(to + LANES * map, sums[map]);
        }
    }
}

// Filters one vector of pixels of row y vertically, from filtered rows.
template <int COUNT>
SEMSPLAT_INLINE void blur_column(const Scratch& s, const Strip& strip, int y, int vector, Floats* sums) {
    for (int map = 0; map < COUNT; ++map) sums[map] = all(0);
    const int from = std::max(strip.first, y - HALF), to = std::min(strip.last, y + HALF + 1);
    const float* row = s.rows.at(vector, from - strip.first);
    for (int k = from; k < to; ++k, row += MAPS * LANES) {
        const Floats c = all(WINDOW_WEIGHTS.w[k - y + HALF]);
        for (int map = 0; map < COUNT; ++map) sums[map] = fma(c, load(row + LANES * map), sums[map]);
    }
}

// Calls f(row, vector) for the rows written, by blocks of columns. The filtered rows around a row of a
// block fit into the L1 cache.
template <class F>
SEMSPLAT_INLINE void for_blocks(const Strip& strip, const Layout& layout, const F& f) {
    enum { BLOCK = 64 / LANES };
    for (int first = 0; first < layout.vectors; first += BLOCK) {
        const int last = std::min<int>(layout.vectors, first + BLOCK);
        for (int row = strip.begin; row < strip.end; ++row) {
            for (int vector = first; vector < last; ++vector) f(row, vector);
        }
    }
}

// SSIM of one strip of one channel. Its derivatives with respect to the local mean, square and product
// of x are written to `by` in padded rows. Returns the sum over the strip's pixels.
double compare(const Strip& strip, const Layout& layout, const Scratch& s, float* const by[DERIVATIVES]) {
    const Floats c1 = all(SSIM_K1 * SSIM_K1), c2 = all(SSIM_K2 * SSIM_K2), two = all(2.0f);
    Floats sums[STRIP];
    for (Floats& sum : sums) sum = all(0);
    for_blocks(strip, layout, [&](int row, int vector) {
        const int lanes = layout.lanes(vector);
        Floats m[MAPS];
        blur_column<MAPS>(s, strip, row, vector, m);
        const Floats mean = m[X] * m[Y], squares = fma(m[X], m[X], m[Y] * m[Y]);
        // SSIM = A B / (D E).
        const Floats A = fma(two, mean, c1), B = fma(two, m[XY] - mean, c2);
        const Floats D = squares + c1, E = m[XX] + m[YY] - squares + c2;
        const Floats by_d = reciprocal(D), by_e = reciprocal(E), inverse = by_d * by_e;
        const Floats value = A * B * inverse;
        sums[row - strip.begin] = sums[row - strip.begin] + first_lanes(lanes, value);
        const Floats found[DERIVATIVES] = {
            two * (m[Y] * (B - A) * inverse - m[X] * value * (by_d - by_e)),
            all(0) - value * by_e,
            two * A * inverse,
        };
        const size_t at = row * layout.stride() + MARGIN + LANES * (size_t)vector;
        for (int i = 0; i < DERIVATIVES; ++i) store(by[i] + at, first_lanes(lanes, found[i]));
    });
    double total = 0;
    for (int row = strip.begin; row < strip.end; ++row) {
        for (int i = 0; i < DERIVATIVES; ++i) {
            float* const line = by[i] + row * layout.stride();
            std::fill_n(line, (int)MARGIN, 0.0f);
            std::fill_n(line + layout.stride() - MARGIN, (int)MARGIN, 0.0f);
        }
        total += sum_of(sums[row - strip.begin]);
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
            float* const to = s.rows.at(vector, row - strip.first);
            for (int i = 0; i < DERIVATIVES; ++i) store(to + LANES * i, sums[i]);
        }
    }
    const auto chain = [weight](const Floats* sums, Floats p, Floats q, Floats g) {
        const Floats slope = fma(q, sums[BY_PRODUCT], fma(p + p, sums[BY_SQUARE], sums[BY_MEAN]));
        return fma(all(weight), slope, g);
    };
    for_blocks(strip, layout, [&](int row, int vector) {
        const int lanes = layout.lanes(vector);
        Floats sums[DERIVATIVES];
        blur_column<DERIVATIVES>(s, strip, row, vector, sums);
        const size_t at = (size_t)row * layout.width + LANES * (size_t)vector;
        // Rows of a block are too short for the processor to predict the next one.
        const size_t next = at + (row + 1 < strip.end ? layout.width : 0);
        for (const float* image : {x, y, (const float*)gradient}) __builtin_prefetch(image + next);
        if (lanes == LANES) {
            store(gradient + at, chain(sums, load(x + at), load(y + at), load(gradient + at)));
            return;
        }
        float parts[3][LANES] = {};
        std::copy_n(x + at, lanes, parts[0]);
        std::copy_n(y + at, lanes, parts[1]);
        std::copy_n(gradient + at, lanes, parts[2]);
        store(parts[2], chain(sums, load(parts[0]), load(parts[1]), load(parts[2])));
        std::copy_n(parts[2], lanes, gradient + at);
    });
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
