#include "depth_filter/depth_filter.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/constants.hpp"

namespace semsplat {
namespace {

enum { LANES = 8 };

// Sums of 1, v, v^2, d, v d and d^2 over the rows of a window, where v is the row relative to the centre.
enum { N, V, VV, D, VD, DD, ROW_SUMS };

// Sums over all pixels of the window; u is the column relative to the centre.
struct WindowSums {
    double n[LANES] = {}, u[LANES] = {}, v[LANES] = {}, uu[LANES] = {}, uv[LANES] = {}, vv[LANES] = {};
    double d[LANES] = {}, ud[LANES] = {}, vd[LANES] = {}, dd[LANES] = {};
};

struct Image {
    const float *inverse, *ones;  // inverse depth; 1 where there is depth
    int width, height;
    size_t at(int y) const { return (size_t)y * width; }
    const float* row(int y) const { return inverse + at(y); }
};

// Column sums of one row of windows, with columns of zeros on both sides.
class Columns {
public:
    Columns(int width, int margin) : margin_(margin), stride_(width + 2 * margin + LANES) {
        for (auto& s : sums_) s.resize(stride_);
    }

    void add_up(const Image& image, int y, int radius) {
        const int first = std::max(0, y - radius), last = std::min(image.height - 1, y + radius);
        int x = 0;
        for (; x + LANES <= image.width; x += LANES) add_up<LANES>(image, y, first, last, x);
        for (; x < image.width; ++x) add_up<1>(image, y, first, last, x);
    }

    WindowSums window(int x, int radius) const {
        WindowSums w;
        const double *n = at(N), *nv = at(V), *nvv = at(VV), *d = at(D), *vd = at(VD), *dd = at(DD);
        for (int k = -radius; k <= radius; ++k) {
            const double u = k, u2 = u * u;
#pragma omp simd
            for (int l = 0; l < LANES; ++l) {
                const int i = x + k + l;
                w.n[l] += n[i];
                w.u[l] += u * n[i];
                w.uu[l] += u2 * n[i];
                w.v[l] += nv[i];
                w.uv[l] += u * nv[i];
                w.vv[l] += nvv[i];
                w.d[l] += d[i];
                w.ud[l] += u * d[i];
                w.vd[l] += vd[i];
                w.dd[l] += dd[i];
            }
        }
        return w;
    }

private:
    template <int COUNT>
    void add_up(const Image& image, int y, int first, int last, int x) {
        double n[COUNT] = {}, nv[COUNT] = {}, nvv[COUNT] = {}, d[COUNT] = {}, vd[COUNT] = {}, dd[COUNT] = {};
        for (int j = first; j <= last; ++j) {
            const float *row = image.row(j) + x, *ones = image.ones + image.at(j) + x;
            const double v = j - y, v2 = v * v;
#pragma omp simd
            for (int l = 0; l < COUNT; ++l) {
                const double value = row[l], one = ones[l];
                n[l] += one;
                nv[l] += v * one;
                nvv[l] += v2 * one;
                d[l] += value;
                vd[l] += v * value;
                dd[l] += value * value;
            }
        }
        std::copy_n(n, COUNT, at(N) + x);
        std::copy_n(nv, COUNT, at(V) + x);
        std::copy_n(nvv, COUNT, at(VV) + x);
        std::copy_n(d, COUNT, at(D) + x);
        std::copy_n(vd, COUNT, at(VD) + x);
        std::copy_n(dd, COUNT, at(DD) + x);
    }

    double* at(int sum) { return sums_[sum].data() + margin_; }
    const double* at(int sum) const { return sums_[sum].data() + margin_; }

    int margin_;
    size_t stride_;
    std::vector<double> sums_[ROW_SUMS];
};

// Value at the centre of the plane fitted to a window, 0 if the window is not planar.
float plane(const WindowSums& w, int l, int radius, const DepthFilter& filter) {
    const double n = w.n[l], side = 2 * radius + 1;
    if (n < filter.min_fraction * side * side) return 0.0f;
    const double u = w.u[l] / n, v = w.v[l] / n, d = w.d[l] / n;
    const double uu = w.uu[l] - n * u * u, uv = w.uv[l] - n * u * v, vv = w.vv[l] - n * v * v;
    const double ud = w.ud[l] - n * u * d, vd = w.vd[l] - n * v * d, dd = w.dd[l] - n * d * d;
    const double determinant = uu * vv - uv * uv;
    if (!(determinant > MIN_PLANE_DETERMINANT * uu * vv)) return 0.0f;
    const double across = (ud * vv - vd * uv) / determinant, down = (vd * uu - ud * uv) / determinant;
    const double variance = (dd - across * ud - down * vd) / (n - 3.0);
    const double most = filter.noise * filter.noise * (1.0 + filter.slack * std::sqrt(2.0 / (n - 3.0)));
    return variance <= most ? (float)(d - across * u - down * v) : 0.0f;
}

float mean_of_like(const Image& image, int x, int y, const DepthFilter& filter) {
    const float middle = image.row(y)[x], by_edge = (float)(1.0 / (filter.edge * filter.edge));
    const float by_radius = 1.0f / ((filter.radius + 1) * (filter.radius + 1));
    float total = 0, weights = 0;
    for (int j = std::max(0, y - filter.radius); j <= std::min(image.height - 1, y + filter.radius); ++j) {
        const float* row = image.row(j);
        for (int i = std::max(0, x - filter.radius); i <= std::min(image.width - 1, x + filter.radius); ++i) {
            const float difference = row[i] - middle;
            const float far = ((i - x) * (i - x) + (j - y) * (j - y)) * by_radius;
            const float near = std::max(0.0f, 1.0f - far);
            const float like = std::max(0.0f, 1.0f - difference * difference * by_edge);
            const float weight = row[i] > 0.0f ? near * like * like : 0.0f;
            total += weight * difference;
            weights += weight;
        }
    }
    return middle + total / weights;
}

}  // namespace

void smooth_inverse_depth(const float* inverse, int width, int height, const DepthFilter& filter, float* out) {
    std::vector<float> ones((size_t)width * height);
    for (size_t i = 0; i < ones.size(); ++i) ones[i] = inverse[i] > 0.0f ? 1.0f : 0.0f;
    const Image image{inverse, ones.data(), width, height};
#pragma omp parallel
    {
        Columns columns(width, filter.count ? filter.radii[0] : 0);
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) {
            const float* row = image.row(y);
            float* smooth = out + (size_t)y * width;
            std::fill_n(smooth, width, 0.0f);
            for (int level = 0; level < filter.count; ++level) {
                const int radius = filter.radii[level];
                columns.add_up(image, y, radius);
                for (int x = 0; x < width; x += LANES) {
                    const int lanes = std::min<int>(LANES, width - x);
                    bool open = false;
                    for (int l = 0; l < lanes; ++l) open |= row[x + l] > 0.0f && smooth[x + l] == 0.0f;
                    if (!open) continue;
                    const WindowSums w = columns.window(x, radius);
                    for (int l = 0; l < lanes; ++l)
                        if (row[x + l] > 0.0f && smooth[x + l] == 0.0f) smooth[x + l] = plane(w, l, radius, filter);
                }
            }
            for (int x = 0; x < width; ++x)
                if (row[x] > 0.0f && !(smooth[x] > 0.0f)) smooth[x] = mean_of_like(image, x, y, filter);
        }
    }
}

}  // namespace semsplat
