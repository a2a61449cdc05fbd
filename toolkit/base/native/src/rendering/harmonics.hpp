// Real spherical harmonics of the degrees 1 to 3, with the signs that splat files use.
#pragma once

namespace semsplat {
namespace {

enum { MAX_HARMONICS = 15 };

// The values of the first `count` (0, 3, 8 or 15) functions in a direction of length 1.
inline void harmonics(int count, const float* direction, float* values) {
    const float x = direction[0], y = direction[1], z = direction[2];
    if (count >= 3) {
        values[0] = -0.48860251f * y;
        values[1] = 0.48860251f * z;
        values[2] = -0.48860251f * x;
    }
    const float xx = x * x, yy = y * y, zz = z * z;
    if (count >= 8) {
        values[3] = 1.0925485f * x * y;
        values[4] = -1.0925485f * y * z;
        values[5] = 0.31539157f * (2.0f * zz - xx - yy);
        values[6] = -1.0925485f * x * z;
        values[7] = 0.54627421f * (xx - yy);
    }
    if (count >= 15) {
        values[8] = -0.59004359f * y * (3.0f * xx - yy);
        values[9] = 2.8906114f * x * y * z;
        values[10] = -0.45704579f * y * (4.0f * zz - xx - yy);
        values[11] = 0.37317633f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
        values[12] = -0.45704579f * x * (4.0f * zz - xx - yy);
        values[13] = 1.4453057f * z * (xx - yy);
        values[14] = -0.59004359f * x * (xx - 3.0f * yy);
    }
}

// Derivative of sum_k weights[k] values[k] with respect to the direction's three entries.
inline void harmonics_gradient(int count, const float* direction, const float* weights, float* gradient) {
    const float x = direction[0], y = direction[1], z = direction[2];
    gradient[0] = gradient[1] = gradient[2] = 0.0f;
    if (count >= 3) {
        gradient[0] -= 0.48860251f * weights[2];
        gradient[1] -= 0.48860251f * weights[0];
        gradient[2] += 0.48860251f * weights[1];
    }
    if (count >= 8) {
        const float a = 1.0925485f, b = 0.31539157f, c = 0.54627421f;
        const float* w = weights + 3;
        gradient[0] += a * y * w[0] - 2.0f * b * x * w[2] - a * z * w[3] + 2.0f * c * x * w[4];
        gradient[1] += a * x * w[0] - a * z * w[1] - 2.0f * b * y * w[2] - 2.0f * c * y * w[4];
        gradient[2] += -a * y * w[1] + 4.0f * b * z * w[2] - a * x * w[3];
    }
    if (count >= 15) {
        const float* w = weights + 8;
        const float xx = x * x, yy = y * y, zz = z * z;
        const float a = 0.59004359f, b = 2.8906114f, c = 0.45704579f, d = 0.37317633f, e = 1.4453057f;
        gradient[0] += -6.0f * a * x * y * w[0] + b * y * z * w[1] + 2.0f * c * x * y * w[2] -
                       6.0f * d * x * z * w[3] - c * (4.0f * zz - 3.0f * xx - yy) * w[4] +
                       2.0f * e * x * z * w[5] - 3.0f * a * (xx - yy) * w[6];
        gradient[1] += -3.0f * a * (xx - yy) * w[0] + b * x * z * w[1] -
                       c * (4.0f * zz - xx - 3.0f * yy) * w[2] - 6.0f * d * y * z * w[3] +
                       2.0f * c * x * y * w[4] - 2.0f * e * y * z * w[5] + 6.0f * a * x * y * w[6];
        gradient[2] += b * x * y * w[1] - 8.0f * c * y * z * w[2] + 3.0f * d * (2.0f * zz - xx - yy) * w[3] -
                       8.0f * c * x * z * w[4] + e * (xx - yy) * w[5];
    }
}

}  // namespace
}  // namespace semsplat
