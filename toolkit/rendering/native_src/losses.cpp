#include "losses.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace semsplat {
namespace {

enum { WINDOW = 11, HALF = WINDOW / 2, STRIP = 32 };

struct GaussianWindow {
    float w[WINDOW];
    GaussianWindow() {
        double total = 0, raw[WINDOW];
        for (int i = 0; i < WINDOW; ++i) total += raw[i] = std::exp(-0.5 * (i - HALF) * (i - HALF) / (1.5 * 1.5));
        for (int i = 0; i < WINDOW; ++i) w[i] = (float)(raw[i] / total);
    }
};
const GaussianWindow WINDOW_WEIGHTS;

// Rows of an image that a strip needs: its own and HALF more on both sides.
struct Strip {
    int begin, end;    // rows written
    int first, last;   // rows read
    Strip(int index, int height)
        : begin(index * STRIP),
          end(std::min(height, begin + STRIP)),
          first(std::max(0, begin - HALF)),
          last(std::min(height, end + HALF)) {}
    int rows() const { return last - first; }
};

// One row through the window; `row` has HALF zeros before and after.
void blur_row(const float* row, int width, float* out) {
    const float* w = WINDOW_WEIGHTS.w;
    for (int x = 0; x < width; ++x) {
        float sum = 0;
        for (int k = 0; k < WINDOW; ++k) sum += w[k] * row[x + k];
        out[x] = sum;
    }
}

// Row y of an image of which `rows` holds the rows from strip.first on, through the window.
void blur_column(const float* rows, const Strip& strip, int y, int width, float* out) {
    std::fill_n(out, width, 0.0f);
    for (int k = std::max(strip.first, y - HALF); k < std::min(strip.last, y + HALF + 1); ++k) {
        const float c = WINDOW_WEIGHTS.w[k - y + HALF];
        const float* from = rows + (size_t)(k - strip.first) * width;
        for (int x = 0; x < width; ++x) out[x] += c * from[x];
    }
}

struct SsimScratch {
    std::vector<float> padded, rows[5], line[5];
    void resize(int width) {
        padded.assign((size_t)width + 2 * HALF, 0.0f);
        for (auto& r : rows) r.resize((size_t)(STRIP + 2 * HALF) * width);
        for (auto& l : line) l.resize((size_t)width);
    }
};

// SSIM of one strip of one channel; derivatives by the local mean, square and product of x
// go to by[0..2]. Returns the sum over its pixels.
double compare_strip(const float* x, const float* y, const Strip& strip, int width, SsimScratch& s,
                     float* const by[3]) {
    constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
    for (int row = strip.first; row < strip.last; ++row) {
        const float *a = x + (size_t)row * width, *b = y + (size_t)row * width;
        const size_t at = (size_t)(row - strip.first) * width;
        float* p = s.padded.data() + HALF;
        for (int map = 0; map < 5; ++map) {
            for (int i = 0; i < width; ++i) {
                p[i] = map == 0 ? a[i] : map == 1 ? b[i] : map == 2 ? a[i] * a[i] : map == 3 ? b[i] * b[i] : a[i] * b[i];
            }
            blur_row(s.padded.data(), width, s.rows[map].data() + at);
        }
    }
    double total = 0;
    for (int row = strip.begin; row < strip.end; ++row) {
        for (int map = 0; map < 5; ++map) blur_column(s.rows[map].data(), strip, row, width, s.line[map].data());
        const float *mx = s.line[0].data(), *my = s.line[1].data(), *xx = s.line[2].data(), *yy = s.line[3].data(),
                    *xy = s.line[4].data();
        const size_t at = (size_t)row * width;
        float sum = 0;
        // SSIM = A B / (D E).
        for (int i = 0; i < width; ++i) {
            const float A = 2 * mx[i] * my[i] + C1, B = 2 * (xy[i] - mx[i] * my[i]) + C2;
            const float D = mx[i] * mx[i] + my[i] * my[i] + C1;
            const float E = xx[i] - mx[i] * mx[i] + yy[i] - my[i] * my[i] + C2;
            const float inverse = 1.0f / (D * E), value = A * B * inverse;
            sum += value;
            by[0][at + i] = 2 * my[i] * (B - A) * inverse - 2 * mx[i] * value * (1.0f / D - 1.0f / E);
            by[1][at + i] = -value / E;
            by[2][at + i] = 2 * A * inverse;
        }
        total += sum;
    }
    return total;
}

// Chain rule back through the windows (symmetric, so their own adjoints) for one strip.
void spread_strip(const float* x, const float* y, float* const by[3], const Strip& strip, int width,
                  float weight, SsimScratch& s, float* gradient) {
    for (int row = strip.first; row < strip.last; ++row) {
        for (int map = 0; map < 3; ++map) {
            std::copy_n(by[map] + (size_t)row * width, width, s.padded.data() + HALF);
            blur_row(s.padded.data(), width, s.rows[map].data() + (size_t)(row - strip.first) * width);
        }
    }
    for (int row = strip.begin; row < strip.end; ++row) {
        for (int map = 0; map < 3; ++map) blur_column(s.rows[map].data(), strip, row, width, s.line[map].data());
        const size_t at = (size_t)row * width;
        for (int i = 0; i < width; ++i) {
            gradient[at + i] +=
                weight * (s.line[0][i] + 2 * x[at + i] * s.line[1][i] + y[at + i] * s.line[2][i]);
        }
    }
}

// Charbonnier: scale * (sqrt(1 + (e / scale)^2) - 1); returns the derivative by e.
inline float robust(float error, float scale, float* value) {
    const float q = error / scale, root = std::sqrt(1.0f + q * q);
    *value = scale * (root - 1.0f);
    return q / root;
}

}  // namespace

double ssim(const float* x, const float* y, int channels, int height, int width, float weight, float* gradient) {
    const size_t n = (size_t)height * width;
    const int strips = (height + STRIP - 1) / STRIP, tasks = strips * channels;
    std::vector<double> sums((size_t)tasks);
    static thread_local std::vector<float> store;
    store.resize(3 * n * channels);
    float* const maps = store.data();
#pragma omp parallel
    {
        SsimScratch scratch;
        scratch.resize(width);
#pragma omp for schedule(dynamic, 1)
        for (int task = 0; task < tasks; ++task) {
            const int c = task / strips;
            float* const by[3] = {maps + 3 * c * n, maps + (3 * c + 1) * n, maps + (3 * c + 2) * n};
            sums[(size_t)task] = compare_strip(x + c * n, y + c * n, Strip(task % strips, height), width, scratch, by);
        }
#pragma omp for schedule(dynamic, 1)
        for (int task = 0; task < (gradient ? tasks : 0); ++task) {
            const int c = task / strips;
            float* const by[3] = {maps + 3 * c * n, maps + (3 * c + 1) * n, maps + (3 * c + 2) * n};
            spread_strip(x + c * n, y + c * n, by, Strip(task % strips, height), width, weight, scratch,
                         gradient + c * n);
        }
    }
    double total = 0;
    for (double s : sums) total += s;
    return total / ((double)n * channels);
}

double rgbd_loss(const float* images, const float* rgb, const float* depth, const float* surface, int height,
                 int width, const RgbdLoss& loss, float* gradient) {
    const size_t n = (size_t)height * width;
    const float flat = loss.colour * (1 - loss.structure) / 3;
    std::vector<double> sums((size_t)height);
#pragma omp parallel for schedule(static)
    for (int row = 0; row < height; ++row) {
        float sum = 0;
        for (size_t i = (size_t)row * width; i < (size_t)(row + 1) * width; ++i) {
            float value;
            for (int c = 0; c < 3; ++c) {
                gradient[c * n + i] = flat * robust(images[c * n + i] - rgb[c * n + i], loss.colour_scale, &value);
                sum += flat * value;
            }
            const float silhouette = images[4 * n + i], measured = depth[i];
            const bool seen = measured > 0, solid = seen && surface[i] > 0 && silhouette > loss.least_silhouette;
            const float inverse = solid ? 1.0f / silhouette : 0.0f;
            const float mean = images[3 * n + i] * inverse;
            // The sensor's noise grows with the square of the depth, and so does the scale.
            const float scale = loss.depth_scale * std::max(measured * measured, 0.25f);
            const float slope = solid ? loss.depth * robust(surface[i] - measured, scale, &value) : 0.0f;
            if (solid) sum += loss.depth * value;
            gradient[3 * n + i] = slope * inverse;
            gradient[4 * n + i] = -slope * mean * inverse - (seen ? loss.silhouette : 0.0f);
            if (seen) sum += loss.silhouette * (1 - silhouette);
        }
        sums[(size_t)row] = sum;
    }
    double total = 0;
    for (double s : sums) total += s;
    if (loss.structure > 0 && loss.colour > 0) {
        const float share = loss.colour * loss.structure;
        total += share * n * (1 - ssim(images, rgb, 3, height, width, -share / 3, gradient));
    }
    return total / n;
}

}  // namespace semsplat
