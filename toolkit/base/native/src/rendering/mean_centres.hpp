// Mean centres of the Gaussians of each pixel, in camera coordinates.
#pragma once

#include <cstddef>

#include "common/camera.hpp"
#include "common/constants.hpp"

namespace semsplat {
namespace {

class MeanCentres {
public:
    MeanCentres(const Pinhole& camera, const double* T, const float* images, const float* centres,
                float min_silhouette)
        : width_(camera.width), plane_((size_t)camera.width * camera.height), images_(images), centres_(centres),
          min_silhouette_(min_silhouette) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R_[i][j] = (float)T[4 * i + j];
            t_[i] = (float)T[4 * i + 3];
        }
    }

    // The points [3, W] of a row in camera coordinates; 0 where the silhouette is below the minimum.
    void row(int y, float* __restrict points) const {
        const size_t start = (size_t)y * width_;
        const float* s = images_ + SILHOUETTE * plane_ + start;
        const float *a = centres_ + start, *b = a + plane_, *c = b + plane_;
        for (int k = 0; k < 3; ++k) {
            const float ra = R_[k][0], rb = R_[k][1], rc = R_[k][2], t = t_[k], least = min_silhouette_;
            float* __restrict out = points + (size_t)k * width_;
            for (int x = 0; x < width_; ++x) {
                const float value = (ra * a[x] + rb * b[x] + rc * c[x]) / s[x] + t;
                out[x] = s[x] >= least ? value : 0.0f;
            }
        }
    }

private:
    int width_;
    size_t plane_;
    const float *images_, *centres_;
    float min_silhouette_, R_[3][3], t_[3];
};

}  // namespace
}  // namespace semsplat
