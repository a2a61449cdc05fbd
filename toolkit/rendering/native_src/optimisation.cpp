#include "optimisation.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace semsplat {
namespace {

enum { WINDOW = 11, HALF = WINDOW / 2 };

struct GaussianWindow {
    float w[WINDOW];
    GaussianWindow() {
        double total = 0, raw[WINDOW];
        for (int i = 0; i < WINDOW; ++i) total += raw[i] = std::exp(-0.5 * (i - HALF) * (i - HALF) / (1.5 * 1.5));
        for (int i = 0; i < WINDOW; ++i) w[i] = (float)(raw[i] / total);
    }
};

// Convolution with the window, zero beyond the image (as the losses of 3DGS have it).
// Symmetric, so it is its own adjoint.
void blur(const float* in, int height, int width, float* scratch, float* out) {
    static const GaussianWindow window;
    const float* w = window.w;
    for (int y = 0; y < height; ++y) {
        float* row = scratch + (size_t)y * width;
        std::fill_n(row, width, 0.0f);
        for (int k = -HALF; k <= HALF; ++k) {
            if (y + k < 0 || y + k >= height) continue;
            const float* from = in + (size_t)(y + k) * width;
            const float c = w[k + HALF];
            for (int x = 0; x < width; ++x) row[x] += c * from[x];
        }
    }
    std::vector<float> padded((size_t)width + 2 * HALF, 0.0f);
    for (int y = 0; y < height; ++y) {
        std::copy_n(scratch + (size_t)y * width, width, padded.data() + HALF);
        float* row = out + (size_t)y * width;
        for (int x = 0; x < width; ++x) {
            float sum = 0;
            for (int k = 0; k < WINDOW; ++k) sum += w[k] * padded[(size_t)x + k];
            row[x] = sum;
        }
    }
}

// One channel; returns the sum of SSIM over its pixels.
double ssim_channel(const float* x, const float* y, int height, int width, float scale, float* gradient) {
    const size_t n = (size_t)height * width;
    constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
    std::vector<float> store(9 * n);
    float *mx = store.data(), *my = mx + n, *xx = my + n, *yy = xx + n, *xy = yy + n, *scratch = xy + n,
          *product = scratch + n;
    blur(x, height, width, scratch, mx);
    blur(y, height, width, scratch, my);
    for (size_t i = 0; i < n; ++i) product[i] = x[i] * x[i];
    blur(product, height, width, scratch, xx);
    for (size_t i = 0; i < n; ++i) product[i] = y[i] * y[i];
    blur(product, height, width, scratch, yy);
    for (size_t i = 0; i < n; ++i) product[i] = x[i] * y[i];
    blur(product, height, width, scratch, xy);
    double total = 0;
    // SSIM = A B / (D E); its derivatives by the local mean, square and product of x.
    float *by_mean = product, *by_square = product + n, *by_product = product + 2 * n;
    for (int row = 0; row < height; ++row) {
        float row_sum = 0;
        for (size_t i = (size_t)row * width; i < (size_t)(row + 1) * width; ++i) {
            const float A = 2 * mx[i] * my[i] + C1, B = 2 * (xy[i] - mx[i] * my[i]) + C2;
            const float D = mx[i] * mx[i] + my[i] * my[i] + C1;
            const float E = xx[i] - mx[i] * mx[i] + yy[i] - my[i] * my[i] + C2;
            const float inverse = 1.0f / (D * E), value = A * B * inverse;
            row_sum += value;
            by_mean[i] = 2 * my[i] * (B - A) * inverse - 2 * mx[i] * value * (1.0f / D - 1.0f / E);
            by_square[i] = -value / E;
            by_product[i] = 2 * A * inverse;
        }
        total += row_sum;
    }
    if (!gradient) return total;
    float *mean_term = mx, *square_term = my, *product_term = xx;
    blur(by_mean, height, width, scratch, mean_term);
    blur(by_square, height, width, scratch, square_term);
    blur(by_product, height, width, scratch, product_term);
    for (size_t i = 0; i < n; ++i) {
        gradient[i] += scale * (mean_term[i] + 2 * x[i] * square_term[i] + y[i] * product_term[i]);
    }
    return total;
}

}  // namespace

void adam_step(const int64_t* ids, int64_t count, int32_t* steps, const AdamGroup* groups, int group_count,
               const AdamSettings& settings) {
    const float beta1 = settings.beta1, beta2 = settings.beta2;
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < count; ++i) {
        const int64_t id = ids[i];
        const int32_t step = ++steps[id];
        const float correction1 = 1.0f / (1.0f - std::pow(beta1, (float)step));
        const float correction2 = 1.0f / (1.0f - std::pow(beta2, (float)step));
        const float settled = settings.settle_steps > 0 ? 1.0f / (1.0f + step / settings.settle_steps) : 1.0f;
        for (int k = 0; k < group_count; ++k) {
            const AdamGroup& group = groups[k];
            const float unit = group.log_unit ? std::exp(group.log_unit[id]) : 1.0f;
            const float rate = group.learning_rate * settled * unit * correction1;
            const float* g = group.gradient + i * group.width;
            float* p = group.parameter + id * group.width;
            float* m = group.first + id * group.width;
            float* v = group.second + id * group.width;
            for (int j = 0; j < group.width; ++j) {
                m[j] += (1 - beta1) * (g[j] - m[j]);
                v[j] += (1 - beta2) * (g[j] * g[j] - v[j]);
                p[j] -= rate * m[j] / (std::sqrt(v[j] * correction2) + settings.epsilon);
            }
        }
    }
}

double ssim(const float* x, const float* y, int channels, int height, int width, float weight, float* gradient) {
    const size_t n = (size_t)height * width;
    const double pixels = (double)n * channels;
    std::vector<double> totals((size_t)channels, 0.0);
#pragma omp parallel for schedule(dynamic, 1)
    for (int c = 0; c < channels; ++c) {
        totals[(size_t)c] = ssim_channel(x + c * n, y + c * n, height, width, (float)(weight / pixels),
                                         gradient ? gradient + c * n : nullptr);
    }
    double total = 0;
    for (double t : totals) total += t;
    return total / pixels;
}

}  // namespace semsplat
