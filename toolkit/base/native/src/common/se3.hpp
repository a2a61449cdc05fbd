// Rigid motions [3, 4] in double precision; geometry/se3.py is the reference.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

namespace semsplat {

// Below this angle the closed forms lose precision and Taylor series are used.
constexpr double SMALL_ANGLE = 1e-4;

using Matrix3 = double[3][3];

// out = identity + first K + second K K, for K = hat(rotation).
inline void series(const double* rotation, double first, double second, Matrix3& out) {
    const double x = rotation[0], y = rotation[1], z = rotation[2];
    const Matrix3 K = {{0, -z, y}, {z, 0, -x}, {-y, x, 0}};
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            double square = 0;
            for (int k = 0; k < 3; ++k) square += K[i][k] * K[k][j];
            out[i][j] = (i == j) + first * K[i][j] + second * square;
        }
    }
}

// One Newton step towards the nearest rotation.
inline void orthonormalise(Matrix3& R) {
    Matrix3 gram, out;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            gram[i][j] = 0;
            for (int k = 0; k < 3; ++k) gram[i][j] += R[k][i] * R[k][j];
        }
    }
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            out[i][j] = 1.5 * R[i][j];
            for (int k = 0; k < 3; ++k) out[i][j] -= 0.5 * R[i][k] * gram[k][j];
        }
    }
    std::memcpy(R, out, sizeof out);
}

// T = exp(tangent) T, for a tangent (translation, rotation).
inline void move(const double* tangent, double (&T)[12]) {
    const double* rotation = tangent + 3;
    const double angle = std::hypot(rotation[0], rotation[1], rotation[2]), square = angle * angle;
    const bool small = angle < SMALL_ANGLE;
    const double a = small ? 1 - square / 6 : std::sin(angle) / angle;
    const double b = small ? 0.5 - square / 24 : (1 - std::cos(angle)) / square;
    const double c = small ? 1.0 / 6 - square / 120 : (angle - std::sin(angle)) / (square * angle);
    Matrix3 turn, jacobian, R;
    series(rotation, a, b, turn);
    series(rotation, b, c, jacobian);
    double t[3];
    for (int i = 0; i < 3; ++i) {
        t[i] = 0;
        for (int k = 0; k < 3; ++k) t[i] += jacobian[i][k] * tangent[k] + turn[i][k] * T[4 * k + 3];
        for (int j = 0; j < 3; ++j) {
            R[i][j] = 0;
            for (int k = 0; k < 3; ++k) R[i][j] += turn[i][k] * T[4 * k + j];
        }
    }
    orthonormalise(R);
    for (int i = 0; i < 3; ++i) {
        std::copy(R[i], R[i] + 3, T + 4 * i);
        T[4 * i + 3] = t[i];
    }
}

}  // namespace semsplat
