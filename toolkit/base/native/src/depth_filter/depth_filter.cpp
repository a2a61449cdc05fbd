#include "depth_filter/depth_filter.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/constants.hpp"
#include "common/simd.hpp"

namespace semsplat {
namespace {

// Pixels whose windows are summed together.
enum { GROUP = 8 };

// Sums over the rows of a window: of 1, v and v^2, where v is the row relative to the centre, and of d, v d
// and d^2. The former are integers, for which single precision is exact.
enum { N, V, VV, COUNTS };
enum { D, VD, DD, DEPTHS };

// Sums over all pixels of the window; u is the column relative to the centre.
struct WindowSums {
    float n[GROUP] = {}, u[GROUP] = {}, v[GROUP] = {}, uu[GROUP] = {}, uv[GROUP] = {}, vv[GROUP] = {};
    double d[GROUP] = {}, ud[GROUP] = {}, vd[GROUP] = {}, dd[GROUP] = {};
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
    Columns(int width, int margin) : margin_(margin), stride_(width + 2 * margin + GROUP) {
        for (auto& s : counts_) s.resize(stride_);
        for (auto& s : depths_) s.resize(stride_);
    }

    void add_up(const Image& image, int y, int radius) {
        const int first = std::max(0, y - radius), last = std::min(image.height - 1, y + radius);
        int x = 0;
        for (; x + GROUP <= image.width; x += GROUP) add_up<GROUP>(image, y, first, last, x);
        for (; x < image.width; ++x) add_up<1>(image, y, first, last, x);
    }

    WindowSums window(int x, int radius) const {
        WindowSums w;
        const float *n = count(N) + x - radius, *nv = count(V) + x - radius, *nvv = count(VV) + x - radius;
        for (int k = -radius; k <= radius; ++k, ++n, ++nv, ++nvv) {
            const float u = (float)k, u2 = u * u;
#pragma omp simd
            for (int l = 0; l < GROUP; ++l) {
                w.n[l] += n[l];
                w.u[l] += u * n[l];
                w.uu[l] += u2 * n[l];
                w.v[l] += nv[l];
                w.uv[l] += u * nv[l];
                w.vv[l] += nvv[l];
            }
        }
        const double *d = depth(D) + x - radius, *vd = depth(VD) + x - radius, *dd = depth(DD) + x - radius;
        for (int k = -radius; k <= radius; ++k, ++d, ++vd, ++dd) {
            const double u = k;
#pragma omp simd
            for (int l = 0; l < GROUP; ++l) {
                w.d[l] += d[l];
                w.ud[l] += u * d[l];
                w.vd[l] += vd[l];
                w.dd[l] += dd[l];
            }
        }
        return w;
    }

private:
    template <int COUNT>
    void add_up(const Image& image, int y, int first, int last, int x) {
        float n[COUNT] = {}, nv[COUNT] = {}, nvv[COUNT] = {};
        double d[COUNT] = {}, vd[COUNT] = {}, dd[COUNT] = {};
        for (int j = first; j <= last; ++j) {
            const float *row = image.row(j) + x, *ones = image.ones + image.at(j) + x;
            const float v = (float)(j - y), v2 = v * v;
#pragma omp simd
            for (int l = 0; l < COUNT; ++l) {
                n[l] += ones[l];
                nv[l] += v * ones[l];
                nvv[l] += v2 * ones[l];
            }
#pragma omp simd
            for (int l = 0; l < COUNT; ++l) {
                const double value = row[l];
                d[l] += value;
                vd[l] += (double)v * value;
                dd[l] += value * value;
            }
        }
        std::copy_n(n, COUNT, count(N) + x);
        std::copy_n(nv, COUNT, count(V) + x);
        std::copy_n(nvv, COUNT, count(VV) + x);
        std::copy_n(d, COUNT, depth(D) + x);
        std::copy_n(vd, COUNT, depth(VD) + x);
        std::copy_n(dd, COUNT, depth(DD) + x);
    }

    float* count(int sum) { return counts_[sum].data() + margin_; }
    const float* count(int sum) const { return counts_[sum].data() + margin_; }
    double* depth(int sum) { return depths_[sum].data() + margin_; }
    const double* depth(int sum) const { return depths_[sum].data() + margin_; }

    int margin_;
    size_t stride_;
    std::vector<float> counts_[COUNTS];
    std::vector<double> depths_[DEPTHS];
};

// Values at the centres of the planes fitted to the windows of a group, 0 if a window is not planar.
// Windows without pixels give NaN, which fails the comparisons.
void planes(const WindowSums& w, int radius, const DepthFilter& filter, float* values) {
    const double side = 2 * radius + 1, least = filter.min_fraction * side * side;
    const double noise = filter.noise * filter.noise, slack = filter.slack;
#pragma omp simd
    for (int l = 0; l < GROUP; ++l) {
        const double n = w.n[l], inverse = 1.0 / n, spare = 1.0 / (n - 3.0);
        const double u = inverse * w.u[l], v = inverse * w.v[l], d = inverse * w.d[l];
        const double uu = w.uu[l] - n * u * u, uv = w.uv[l] - n * u * v, vv = w.vv[l] - n * v * v;
        const double ud = w.ud[l] - n * u * d, vd = w.vd[l] - n * v * d, dd = w.dd[l] - n * d * d;
        const double determinant = uu * vv - uv * uv, by_determinant = 1.0 / determinant;
        const double across = (ud * vv - vd * uv) * by_determinant, down = (vd * uu - ud * uv) * by_determinant;
        const double variance = (dd - across * ud - down * vd) * spare;
        const double most = noise * (1.0 + slack * std::sqrt(2.0 * spare));
        const bool planar = (n >= least) & (determinant > MIN_PLANE_DETERMINANT * uu * vv) & (variance <= most);
        values[l] = (float)(planar ? d - across * u - down * v : 0.0);
    }
}

// Means of the neighbours on the same surface for LANES pixels from x, whose windows lie in the image.
SEMSPLAT_INLINE void means_of_like(const Image& image, int x, int y, const DepthFilter& filter, float* means) {
    const int radius = filter.radius;
    const Floats zero = all(0.0f), one = all(1.0f), middle = load(image.row(y) + x);
    const Floats by_edge = all((float)(1.0 / (filter.edge * filter.edge)));
    const float by_radius = 1.0f / ((radius + 1) * (radius + 1));
    Floats total = zero, weights = zero;
    for (int j = std::max(0, y - radius); j <= std::min(image.height - 1, y + radius); ++j) {
        const float* row = image.row(j) + x;
        for (int i = -radius; i <= radius; ++i) {
            const float near = 1.0f - (i * i + (j - y) * (j - y)) * by_radius;
            if (near <= 0.0f) continue;
            const Floats value = load(row + i), difference = value - middle;
            const Floats like = maximum(zero, fnma(difference * difference, by_edge, one));
            const Floats weight = keep(lt(zero, value), all(near) * like * like);
            total = fma(weight, difference, total);
            weights = weights + weight;
        }
    }
    store(means, middle + total / weights);
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
                for (int x = 0; x < width; x += GROUP) {
                    const int lanes = std::min<int>(GROUP, width - x);
                    bool open = false;
                    for (int l = 0; l < lanes; ++l) open |= row[x + l] > 0.0f && smooth[x + l] == 0.0f;
                    if (!open) continue;
                    float values[GROUP];
                    planes(columns.window(x, radius), radius, filter, values);
                    for (int l = 0; l < lanes; ++l)
                        if (row[x + l] > 0.0f && smooth[x + l] == 0.0f) smooth[x + l] = values[l];
                }
            }
            const auto open = [&](int x) { return row[x] > 0.0f && !(smooth[x] > 0.0f); };
            for (int x = 0; x < width; ++x) {
                if (!open(x)) continue;
                if (x < filter.radius || x + LANES + filter.radius > width) {
                    smooth[x] = mean_of_like(image, x, y, filter);
                    continue;
                }
                float means[LANES];
                means_of_like(image, x, y, filter, means);
                const int first = x;
                for (; x < first + LANES; ++x)
                    if (open(x)) smooth[x] = means[x - first];
                --x;
            }
        }
    }
}

}  // namespace semsplat
