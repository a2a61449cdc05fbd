// Bundle adjustment over inverse depths (Civera et al. 2008), in double precision and on one thread, so
// that results do not depend on the number of threads.
//
// The point of a landmark with pixel ray x and inverse depth q of anchor a in camera j is, up to the
// factor q that projection cancels, Y = R_ja x + q t_ja. It stays finite for points at infinity.

#include "bundle_adjustment/bundle_adjustment.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/se3.hpp"

namespace semsplat {
namespace {

enum { POSE = 6 };

// Nearer to the camera's plane, points have no usable projection.
constexpr double MIN_COSINE = 1e-3;
// Error of points behind a camera, in pixels: constant, so that they do not attract the camera.
constexpr double BEHIND = 1e3;
constexpr double FIRST_DAMPING = 1e-4, MIN_DAMPING = 1e-9, MAX_DAMPING = 1e8;
// Added to the diagonal before damping: directions without information, such as the scale, stay put.
constexpr double TINY = 1e-12;
// Damping for the uncertainty of the focal length: the scale may be free, and rounding would make the
// equations indefinite.
constexpr double GAUGE_DAMPING = 1e-8;

struct Parameters {
    std::vector<double> T_camera_world, inverse_depth;
    double log_focal;
};

// One residual and its derivatives.
struct Residual {
    double r[2];
    double weight;  // Huber's
    double by_anchor[2][6], by_pose[2][6], by_depth[2], by_focal[2];
};

double huber_cost(double distance, double huber) {
    return distance <= huber ? 0.5 * distance * distance : huber * (distance - 0.5 * huber);
}

// Symmetric positive definite system with a dense Cholesky factorisation.
class Dense {
public:
    explicit Dense(int n) : n(n), H((size_t)n * n), g(n) {}

    void clear() {
        std::fill(H.begin(), H.end(), 0.0);
        std::fill(g.begin(), g.end(), 0.0);
    }

    double& at(int i, int j) { return H[(size_t)i * n + j]; }  // the lower triangle, j <= i

    // Replaces H by its factor and g by the solution of H x = g. False if H is not positive definite.
    bool solve() {
        for (int j = 0; j < n; ++j) {
            double* row_j = &H[(size_t)j * n];
            double diagonal = row_j[j];
            for (int k = 0; k < j; ++k) diagonal -= row_j[k] * row_j[k];
            if (!(diagonal > 0)) return false;
            const double root = std::sqrt(diagonal);
            row_j[j] = root;
            for (int i = j + 1; i < n; ++i) {
                double* row_i = &H[(size_t)i * n];
                double sum = row_i[j];
                for (int k = 0; k < j; ++k) sum -= row_i[k] * row_j[k];
                row_i[j] = sum / root;
            }
        }
        for (int i = 0; i < n; ++i) {
            for (int k = 0; k < i; ++k) g[i] -= at(i, k) * g[k];
            g[i] /= at(i, i);
        }
        for (int i = n - 1; i >= 0; --i) {
            for (int k = i + 1; k < n; ++k) g[i] -= at(k, i) * g[k];
            g[i] /= at(i, i);
        }
        return true;
    }

    int n;
    std::vector<double> H, g;
};

class Adjustment {
public:
    Adjustment(const Bundle& bundle, const BundleSettings& settings)
        : bundle(bundle), settings(settings), offset(bundle.poses), free(0) {
        for (int p = 0; p < bundle.poses; ++p) {
            offset[p] = bundle.fixed[p] ? -1 : free;
            if (!bundle.fixed[p]) free += POSE;
        }
        focal_at = free;
        size = free + (settings.focal ? 1 : 0);
        first.assign((size_t)bundle.landmarks + 1, bundle.observations);
        for (int64_t k = bundle.observations; k-- > 0;) first[bundle.landmark[k]] = k;
        for (int l = bundle.landmarks; l-- > 0;) first[l] = std::min(first[l], first[l + 1]);
    }

    BundleResult run() {
        Parameters now = {
            std::vector<double>(bundle.T_camera_world, bundle.T_camera_world + 12 * (size_t)bundle.poses),
            std::vector<double>(bundle.inverse_depth, bundle.inverse_depth + bundle.landmarks), 0.0};
        BundleResult result = {};
        result.cost_before = result.cost = cost_of(now);
        Dense full(size), reduced(size);
        std::vector<double> depth_H(bundle.landmarks), depth_g(bundle.landmarks);
        double damping = FIRST_DAMPING;
        while (result.iterations < settings.iterations && !result.converged) {
            ++result.iterations;
            linearise(now, full);
            bool better = false;
            while (!better && damping < MAX_DAMPING) {
                Parameters next = now;
                const double cost = step(now, full, damping, reduced, next) ? cost_of(next) : INFINITY;
                better = cost < result.cost;
                if (better) {
                    result.converged = result.cost - cost < settings.min_decrease * result.cost;
                    result.cost = cost;
                    now = std::move(next);
                    damping = std::max(damping / 10, MIN_DAMPING);
                } else {
                    damping *= 10;
                }
            }
            if (!better) result.converged = true;
        }
        cost_of(now);  // a rejected step left its distances
        result.focal_factor = std::exp(now.log_focal);
        if (settings.focal) {
            linearise(now, full);
            Parameters unused = now;
            // The last diagonal entry of a Cholesky factor is what remains after elimination.
            if (step(now, full, GAUGE_DAMPING, reduced, unused)) {
                const double root = reduced.at(focal_at, focal_at);
                result.focal_information = root * root;
            }
        }
        std::copy(now.T_camera_world.begin(), now.T_camera_world.end(), bundle.T_camera_world);
        std::copy(now.inverse_depth.begin(), now.inverse_depth.end(), bundle.inverse_depth);
        return result;
    }

private:
    // Blocks of the normal equations that couple a landmark with the poses and the focal length.
    struct Landmark {
        double H, g;
        std::vector<int> at;        // offsets of the coupled parameters, one entry per scalar
        std::vector<double> along;  // coupling
    };

    const Bundle& bundle;
    const BundleSettings& settings;
    std::vector<int> offset;  // of each pose in the parameters, -1 if fixed
    int free, focal_at, size;
    std::vector<int64_t> first;  // observation of each landmark
    std::vector<Landmark> landmarks;

    // Returns the distance of an observation from the projection, and fills in `out` if it is given.
    double residual_of(const Parameters& at, int l, int64_t k, Residual* out) const {
        const int a = bundle.anchor[l], j = bundle.pose[k];
        const double* Ta = &at.T_camera_world[12 * (size_t)a];
        const double* Tj = &at.T_camera_world[12 * (size_t)j];
        const double factor = std::exp(at.log_focal), fx = factor * settings.fx, fy = factor * settings.fy;
        const double q = at.inverse_depth[l];
        const double ray[3] = {(bundle.anchor_pixel[2 * l] - settings.cx) / fx,
                               (bundle.anchor_pixel[2 * l + 1] - settings.cy) / fy, 1.0};
        double R[9], t[3], Y[3];
        for (int r = 0; r < 3; ++r) {
            for (int c = 0; c < 3; ++c) {
                R[3 * r + c] = Tj[4 * r] * Ta[4 * c] + Tj[4 * r + 1] * Ta[4 * c + 1] + Tj[4 * r + 2] * Ta[4 * c + 2];
            }
        }
        for (int r = 0; r < 3; ++r) {
            t[r] = Tj[4 * r + 3] - (R[3 * r] * Ta[3] + R[3 * r + 1] * Ta[7] + R[3 * r + 2] * Ta[11]);
            Y[r] = R[3 * r] * ray[0] + R[3 * r + 1] * ray[1] + R[3 * r + 2] + q * t[r];
        }
        if (!(Y[2] > MIN_COSINE)) return BEHIND;
        const double inverse = 1 / Y[2], x = Y[0] * inverse, y = Y[1] * inverse;
        const double ru = fx * x + settings.cx - bundle.pixel[2 * k];
        const double rv = fy * y + settings.cy - bundle.pixel[2 * k + 1];
        const double distance = std::hypot(ru, rv);
        if (!out) return distance;
        out->r[0] = ru;
        out->r[1] = rv;
        out->weight = distance <= settings.huber ? 1.0 : settings.huber / distance;
        const double P[2][3] = {{fx * inverse, 0, -fx * x * inverse}, {0, fy * inverse, -fy * y * inverse}};
        for (int i = 0; i < 2; ++i) {
            const double* p = P[i];
            double pR[3];
            for (int c = 0; c < 3; ++c) pR[c] = p[0] * R[c] + p[1] * R[3 + c] + p[2] * R[6 + c];
            for (int c = 0; c < 3; ++c) {
                out->by_pose[i][c] = q * p[c];
                out->by_anchor[i][c] = -q * pR[c];
            }
            // p [-Y]x = Y x p, and pR [ray]x = pR x ray.
            out->by_pose[i][3] = Y[1] * p[2] - Y[2] * p[1];
            out->by_pose[i][4] = Y[2] * p[0] - Y[0] * p[2];
            out->by_pose[i][5] = Y[0] * p[1] - Y[1] * p[0];
            out->by_anchor[i][3] = pR[1] * ray[2] - pR[2] * ray[1];
            out->by_anchor[i][4] = pR[2] * ray[0] - pR[0] * ray[2];
            out->by_anchor[i][5] = pR[0] * ray[1] - pR[1] * ray[0];
            out->by_depth[i] = p[0] * t[0] + p[1] * t[1] + p[2] * t[2];
            // The ray and the projection both depend on the focal length.
            out->by_focal[i] = (i == 0 ? fx * x : fy * y) - pR[0] * ray[0] - pR[1] * ray[1];
        }
        return distance;
    }

    double cost_of(const Parameters& at) const {
        double cost = 0;
        for (int l = 0; l < bundle.landmarks; ++l) {
            for (int64_t k = first[l]; k < first[l + 1]; ++k) {
                const double distance = residual_of(at, l, k, nullptr);
                bundle.distance[k] = distance;
                cost += huber_cost(distance, settings.huber);
            }
            const double off = at.inverse_depth[l] - bundle.prior[2 * l];
            cost += 0.5 * bundle.prior[2 * l + 1] * off * off;
        }
        return cost;
    }

    // Sums the normal equations of poses and focal length in `full`, those of landmarks in `landmarks`.
    void linearise(const Parameters& at, Dense& full) {
        full.clear();
        landmarks.resize(bundle.landmarks);
        std::vector<double> J[2];
        for (int l = 0; l < bundle.landmarks; ++l) {
            Landmark& own = landmarks[l];
            const double information = bundle.prior[2 * l + 1];
            own.H = information;
            own.g = -information * (at.inverse_depth[l] - bundle.prior[2 * l]);
            own.at.clear();
            own.along.clear();
            const int anchor_at = offset[bundle.anchor[l]];
            if (anchor_at >= 0) couple(own, anchor_at, POSE);
            if (settings.focal) couple(own, focal_at, 1);
            const size_t focal_slot = anchor_at >= 0 ? POSE : 0;
            for (int64_t k = first[l]; k < first[l + 1]; ++k) {
                Residual r;
                if (residual_of(at, l, k, &r) >= BEHIND) continue;
                const int pose_at = offset[bundle.pose[k]];
                const size_t pose_slot = own.at.size();
                if (pose_at >= 0) couple(own, pose_at, POSE);
                for (int i = 0; i < 2; ++i) {
                    const double w = r.weight;
                    own.H += w * r.by_depth[i] * r.by_depth[i];
                    own.g -= w * r.by_depth[i] * r.r[i];
                    Part parts[3];
                    int count = 0;
                    if (anchor_at >= 0) parts[count++] = {anchor_at, POSE, r.by_anchor[i], 0};
                    if (pose_at >= 0) parts[count++] = {pose_at, POSE, r.by_pose[i], pose_slot};
                    if (settings.focal) parts[count++] = {focal_at, 1, &r.by_focal[i], focal_slot};
                    for (int m = 0; m < count; ++m) {
                        for (int n = 0; n < count; ++n) add(full, parts[m], parts[n], w);
                        for (int c = 0; c < parts[m].size; ++c) {
                            full.g[parts[m].at + c] -= w * parts[m].J[c] * r.r[i];
                            own.along[parts[m].slot + c] += w * parts[m].J[c] * r.by_depth[i];
                        }
                    }
                }
            }
        }
    }

    struct Part {
        int at, size;
        const double* J;
        size_t slot;
    };

    static void couple(Landmark& own, int at, int count) {
        for (int c = 0; c < count; ++c) {
            own.at.push_back(at + c);
            own.along.push_back(0);
        }
    }

    static void add(Dense& full, const Part& a, const Part& b, double weight) {
        if (a.at < b.at) return;  // the lower triangle
        for (int i = 0; i < a.size; ++i) {
            const int last = a.at == b.at ? i + 1 : b.size;
            for (int j = 0; j < last; ++j) full.at(a.at + i, b.at + j) += weight * a.J[i] * b.J[j];
        }
    }

    // Solves the damped equations and applies the step. False if they are singular.
    bool step(const Parameters& now, const Dense& full, double damping, Dense& reduced, Parameters& next) {
        reduced.H = full.H;
        reduced.g = full.g;
        for (int i = 0; i < size; ++i) {
            double& diagonal = reduced.at(i, i);
            diagonal += damping * diagonal + TINY;
        }
        for (const Landmark& own : landmarks) {
            const double inverse = 1 / (own.H * (1 + damping) + TINY);
            const size_t count = own.at.size();
            for (size_t m = 0; m < count; ++m) {
                const double scaled = own.along[m] * inverse;
                double* row = &reduced.H[(size_t)own.at[m] * size];
                for (size_t n = 0; n < count; ++n) {
                    if (own.at[n] <= own.at[m]) row[own.at[n]] -= scaled * own.along[n];
                }
                reduced.g[own.at[m]] -= scaled * own.g;
            }
        }
        if (!reduced.solve()) return false;
        for (int p = 0; p < bundle.poses; ++p) {
            if (offset[p] < 0) continue;
            double T[12];
            std::copy_n(&now.T_camera_world[12 * (size_t)p], 12, T);
            move(&reduced.g[offset[p]], T);
            std::copy_n(T, 12, &next.T_camera_world[12 * (size_t)p]);
        }
        if (settings.focal) next.log_focal = now.log_focal + reduced.g[focal_at];
        for (int l = 0; l < bundle.landmarks; ++l) {
            const Landmark& own = landmarks[l];
            double g = own.g;
            for (size_t m = 0; m < own.at.size(); ++m) g -= own.along[m] * reduced.g[own.at[m]];
            const double moved = now.inverse_depth[l] + g / (own.H * (1 + damping) + TINY);
            next.inverse_depth[l] = std::max(moved, settings.min_inverse_depth);
        }
        return true;
    }
};

}  // namespace

BundleResult adjust(const Bundle& bundle, const BundleSettings& settings) {
    return Adjustment(bundle, settings).run();
}

}  // namespace semsplat
