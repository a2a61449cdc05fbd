// Dense frame-to-model alignment: photometric and point-to-plane residuals (mission section 7).
//
// A frame pixel's point Y = T_model_frame P is projected into the rendered view. Photometric:
// model intensity there minus the frame's; geometric: distance of Y from the model's plane.
// Derivatives come from the model, which is smoother than a camera image. Weights follow
// Student's t distribution (STUDENT_T_DOF), whose scales the caller re-estimates from the sums.
#include "alignment/alignment.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "common/constants.hpp"

namespace semsplat {
namespace {

enum { ROWS = 4 };  // rows summed in single precision before doubles take over

static_assert(sizeof(NormalEquations) == ALIGNMENT_SUMS * sizeof(double), "Python allocates the sums");

// Sums of one group of rows: upper triangles of the two blocks of the Hessian.
struct Sums {
    float pose[21], pose_gain[6], pose_bias[6], gain_gain, gain_bias, bias_bias;
    float g[PARAMETERS];
    float intensity_pixels, depth_pixels, intensity_squares, depth_squares, frame_pixels;
};

inline void add_outer(Sums& s, const float* J, float weight, float residual) {
    int k = 0;
    for (int i = 0; i < 6; ++i) {
        const float wj = weight * J[i];
        for (int j = i; j < 6; ++j) s.pose[k++] += wj * J[j];
        s.g[i] += wj * residual;
    }
}

// Whether neighbours a and b of a pixel with depth z lie on its surface: near it, or on one plane
// with it, however steep, since inverse depth is linear on a plane's image.
inline bool same_surface(float a, float z, float b) {
    return std::fabs(b - a) <= MAX_DEPTH_STEP * z || std::fabs(z / a + z / b - 2.0f) <= 0.5f * MAX_DEPTH_STEP;
}

// Bilinear intensity, derivatives and depth; false where a tap is unusable or an edge is crossed.
inline bool look_up(const ModelLevel& model, float u, float v, float* value) {
    const int x = (int)u, y = (int)v, W = model.camera.width;
    const float a = u - x, b = v - y;
    const float* p00 = model.texture + 4 * ((size_t)y * W + x);
    const float* p01 = p00 + 4;
    const float* p10 = p00 + 4 * W;
    const float* p11 = p10 + 4;
    const float nearest = std::min(std::min(p00[3], p01[3]), std::min(p10[3], p11[3]));
    const float farthest = std::max(std::max(p00[3], p01[3]), std::max(p10[3], p11[3]));
    if (!(nearest > 0)) return false;
    if (farthest - nearest > MAX_DEPTH_STEP * nearest) {
        // Two opposite taps that lie on planes with all their neighbours join the four.
        const float* plane = model.surface + 4 * ((size_t)y * W + x);
        if (plane[3] == 0 || plane[4 * (W + 1) + 3] == 0) return false;
    }
    const float w00 = (1 - a) * (1 - b), w01 = a * (1 - b), w10 = (1 - a) * b, w11 = a * b;
    for (int k = 0; k < 4; ++k) value[k] = w00 * p00[k] + w01 * p01[k] + w10 * p10[k] + w11 * p11[k];
    return true;
}

void accumulate_rows(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& s,
                     const float* R, const float* t, int row_begin, int row_end, Sums& sums) {
    const Pinhole& fc = frame.camera;
    const Pinhole& mc = model.camera;
    const float gain = (float)s.gain, bias = (float)s.bias, gate = (float)s.max_distance;
    const float photometric_weight = (float)s.photometric_weight;
    const float inverse_si = (float)(1.0 / s.sigma_intensity), inverse_sd = (float)(1.0 / s.sigma_depth);
    for (int py = row_begin; py < row_end; ++py) {
        const float ray_y = (py - fc.cy) / fc.fy;
        for (int px = 0; px < fc.width; ++px) {
            const size_t at = (size_t)py * fc.width + px;
            const float z = frame.depth[at];
            if (!(z > 0)) continue;
            const float ray_x = (px - fc.cx) / fc.fx;
            const float Y[3] = {z * (R[0] * ray_x + R[1] * ray_y + R[2]) + t[0],
                                z * (R[3] * ray_x + R[4] * ray_y + R[5]) + t[1],
                                z * (R[6] * ray_x + R[7] * ray_y + R[8]) + t[2]};
            if (!(Y[2] > NEAR_M)) continue;
            const float inverse_z = 1.0f / Y[2];
            const float u = mc.fx * Y[0] * inverse_z + mc.cx, v = mc.fy * Y[1] * inverse_z + mc.cy;
            if (!(u >= 0 && v >= 0 && u < mc.width - 1 && v < mc.height - 1)) continue;
            sums.frame_pixels += 1;

            // Geometry: the plane of the nearest model pixel.
            const float* plane = model.surface + 4 * ((size_t)(v + 0.5f) * mc.width + (size_t)(u + 0.5f));
            const float* texel = model.texture + 4 * ((size_t)(v + 0.5f) * mc.width + (size_t)(u + 0.5f));
            const float seen = texel[3];
            if (!(seen > 0 && std::fabs(seen - Y[2]) < gate * seen)) continue;
            float J[6];
            if (plane[0] != 0 || plane[1] != 0 || plane[2] != 0) {
                const float* n = plane;
                const float r = n[0] * Y[0] + n[1] * Y[1] + n[2] * Y[2] - plane[3];
                // The sensor's noise grows with the square of the depth. Weight and lever are taken
                // from the view: with the frame's own depth they would go with its noise, nearer
                // points would count for more, and the camera would be moved by their difference.
                const float scale = inverse_sd / std::max(seen * seen, MIN_NOISE_DEPTH_M * MIN_NOISE_DEPTH_M);
                const float to_view = seen * inverse_z;
                const float X[3] = {Y[0] * to_view, Y[1] * to_view, seen};
                const float q = r * scale;
                const float robust = (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + q * q);
                const float weight = robust * scale * scale;
                J[0] = n[0];
                J[1] = n[1];
                J[2] = n[2];
                J[3] = X[1] * n[2] - X[2] * n[1];
                J[4] = X[2] * n[0] - X[0] * n[2];
                J[5] = X[0] * n[1] - X[1] * n[0];
                add_outer(sums, J, weight, r);
                sums.depth_pixels += 1;
                sums.depth_squares += robust * q * q;
            }

            float value[4];
            if (!look_up(model, u, v, value)) continue;
            const float own = frame.intensity[at];
            const float r = value[0] - (gain * own + bias);
            const float q = r * inverse_si;
            const float robust = (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + q * q);
            const float weight = photometric_weight * robust * inverse_si * inverse_si;
            const float a = value[1] * mc.fx * inverse_z, b = value[2] * mc.fy * inverse_z;
            const float c = -(a * Y[0] + b * Y[1]) * inverse_z;
            J[0] = a;
            J[1] = b;
            J[2] = c;
            J[3] = Y[1] * c - Y[2] * b;
            J[4] = Y[2] * a - Y[0] * c;
            J[5] = Y[0] * b - Y[1] * a;
            add_outer(sums, J, weight, r);
            for (int k = 0; k < 6; ++k) {
                sums.pose_gain[k] -= weight * J[k] * own;
                sums.pose_bias[k] -= weight * J[k];
            }
            sums.gain_gain += weight * own * own;
            sums.gain_bias += weight * own;
            sums.bias_bias += weight;
            sums.g[6] -= weight * own * r;
            sums.g[7] -= weight * r;
            sums.intensity_pixels += 1;
            sums.intensity_squares += robust * q * q;
        }
    }
}

void add(const Sums& s, NormalEquations& out) {
    int from = 0;
    for (int i = 0; i < 6; ++i) {
        // Row i of the 8x8 upper triangle starts here.
        double* row = out.H + i * PARAMETERS - i * (i - 1) / 2;
        for (int j = i; j < 6; ++j) row[j - i] += s.pose[from++];
        row[6 - i] += s.pose_gain[i];
        row[7 - i] += s.pose_bias[i];
    }
    out.H[33] += s.gain_gain;
    out.H[34] += s.gain_bias;
    out.H[35] += s.bias_bias;
    for (int k = 0; k < PARAMETERS; ++k) out.g[k] += s.g[k];
    out.intensity_pixels += s.intensity_pixels;
    out.depth_pixels += s.depth_pixels;
    out.intensity_squares += s.intensity_squares;
    out.depth_squares += s.depth_squares;
    out.frame_pixels += s.frame_pixels;
}

}  // namespace

void accumulate(const ModelLevel& model, const FrameLevel& frame, const AlignmentSettings& settings,
                NormalEquations& out) {
    const int height = frame.camera.height, groups = (height + ROWS - 1) / ROWS;
    float R[9], t[3];
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) R[3 * i + j] = (float)settings.T_model_frame[4 * i + j];
        t[i] = (float)settings.T_model_frame[4 * i + 3];
    }
    std::vector<Sums> sums((size_t)groups);
#pragma omp parallel for schedule(dynamic, 2)
    for (int group = 0; group < groups; ++group) {
        Sums local;
        std::memset(&local, 0, sizeof local);
        accumulate_rows(model, frame, settings, R, t, group * ROWS, std::min(height, (group + 1) * ROWS), local);
        sums[(size_t)group] = local;
    }
    std::memset(&out, 0, sizeof out);
    for (const Sums& s : sums) add(s, out);
}

void intensity_of(const Pinhole& camera, const float* images, float least_silhouette, float* intensity) {
    const int64_t plane = (int64_t)camera.width * camera.height;
    const float *r = images, *g = images + plane, *b = images + 2 * plane, *s = images + SILHOUETTE * plane;
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < plane; ++i) {
        // As composited, not divided by the silhouette: mapping fits it like that, and the
        // difference would come back as gain, brighter with every keyframe.
        const float luma = LUMA_RED * r[i] + LUMA_GREEN * g[i] + LUMA_BLUE * b[i];
        intensity[i] = s[i] >= least_silhouette ? luma : 0.0f;
    }
}

namespace {

// From pixels to the projections of their Gaussians' mean centres.
class CentreOffsets {
public:
    CentreOffsets(const Pinhole& camera, const double* T, const float* images, const float* centres,
                  float least_silhouette)
        : camera_(camera), images_(images), centres_(centres), least_(least_silhouette),
          plane_((size_t)camera.width * camera.height) {
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) R_[3 * i + j] = (float)T[4 * i + j];
            t_[i] = (float)T[4 * i + 3];
        }
    }

    bool solid(size_t i) const { return images_[SILHOUETTE * plane_ + i] >= least_; }

    // Zero where the view is thin, and where the centre lies so far off that there is an edge.
    void at(int x, int y, float& across, float& down) const {
        across = down = 0.0f;
        const size_t i = (size_t)y * camera_.width + x;
        if (!solid(i)) return;
        const float inverse = 1.0f / images_[SILHOUETTE * plane_ + i];
        const float a = centres_[i] * inverse, b = centres_[plane_ + i] * inverse,
                    c = centres_[2 * plane_ + i] * inverse;
        const float z = R_[6] * a + R_[7] * b + R_[8] * c + t_[2];
        if (!(z > MIN_CENTRE_DEPTH_M)) return;
        const float u = camera_.fx * (R_[0] * a + R_[1] * b + R_[2] * c + t_[0]) / z + camera_.cx - x;
        const float v = camera_.fy * (R_[3] * a + R_[4] * b + R_[5] * c + t_[1]) / z + camera_.cy - y;
        if (!(std::fabs(u) <= MAX_CENTRE_OFFSET_PX && std::fabs(v) <= MAX_CENTRE_OFFSET_PX)) return;
        across = u;
        down = v;
    }

private:
    const Pinhole& camera_;
    const float *images_, *centres_;
    float least_, R_[9], t_[3];
    size_t plane_;
};

}  // namespace

void centred_intensity(const Pinhole& camera, const double* T, const float* images, const float* centres,
                       float least_silhouette, float* intensity) {
    const int W = camera.width, H = camera.height;
    std::vector<float> drawn((size_t)W * H);
    intensity_of(camera, images, least_silhouette, drawn.data());
    const CentreOffsets offsets(camera, T, images, centres, least_silhouette);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            const size_t i = (size_t)y * W + x;
            intensity[i] = drawn[i];
            if (x == 0 || y == 0 || x == W - 1 || y == H - 1 || !offsets.solid(i)) continue;
            // Beside a hole the derivatives would be those of its border.
            if (!(offsets.solid(i - 1) && offsets.solid(i + 1) && offsets.solid(i - W) && offsets.solid(i + W)))
                continue;
            float across, down;
            offsets.at(x, y, across, down);
            intensity[i] -= 0.5f * (drawn[i + 1] - drawn[i - 1]) * across;
            intensity[i] -= 0.5f * (drawn[i + W] - drawn[i - W]) * down;
        }
    }
}

void texture_at_centres(const Pinhole& camera, const double* T, const float* images, const float* centres,
                        float least_silhouette, const float* rgb, float* out) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    const CentreOffsets offsets(camera, T, images, centres, least_silhouette);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            float across, down;
            offsets.at(x, y, across, down);
            const float u = std::min(std::max(x + across, 0.0f), (float)(W - 1));
            const float v = std::min(std::max(y + down, 0.0f), (float)(H - 1));
            const int left = std::max(0, std::min((int)u, W - 2)), top = std::max(0, std::min((int)v, H - 2));
            const int right = std::min(left + 1, W - 1), below = std::min(top + 1, H - 1);
            const float a = u - left, b = v - top;
            for (int k = 0; k < 3; ++k) {
                const float* image = rgb + k * plane;
                const float *upper = image + (size_t)top * W, *lower = image + (size_t)below * W;
                out[k * plane + (size_t)y * W + x] = (upper[left] * (1 - a) + upper[right] * a) * (1 - b) +
                                                     (lower[left] * (1 - a) + lower[right] * a) * b;
            }
        }
    }
}

// Front-to-back compositing weighs the nearer of two overlapping Gaussians more, so on a
// slanted surface the mean depth belongs to a point up to half a pixel off the ray. The mean
// of the centres themselves does lie on the surface: intersect the ray with the plane there.
void surface_depth(const Pinhole& camera, const double* T, const float* images, const float* centres,
                   float least_silhouette, float* depth) {
    const int W = camera.width, H = camera.height;
    const size_t plane = (size_t)W * H;
    float R[9], t[3];
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) R[3 * i + j] = (float)T[4 * i + j];
        t[i] = (float)T[4 * i + 3];
    }
    std::vector<float> points(3 * plane);
    // Neighbours lie two pixels apart in both directions; times z^2 this is the shortest normal.
    const float footprint = 4.0f * MIN_NORMAL / (camera.fx * camera.fy);
#pragma omp parallel
    {
#pragma omp for schedule(static)
        for (int y = 0; y < H; ++y) {
            for (int x = 0; x < W; ++x) {
                const size_t i = (size_t)y * W + x;
                const float s = images[SILHOUETTE * plane + i], inverse = s >= least_silhouette ? 1.0f / s : 0.0f;
                const float a = centres[i] * inverse, b = centres[plane + i] * inverse,
                            c = centres[2 * plane + i] * inverse;
                for (int k = 0; k < 3; ++k) {
                    points[3 * i + k] = inverse > 0 ? R[3 * k] * a + R[3 * k + 1] * b + R[3 * k + 2] * c + t[k] : 0.0f;
                }
            }
        }
#pragma omp for schedule(static)
        for (int y = 0; y < H; ++y) {
            for (int x = 0; x < W; ++x) {
                const size_t i = (size_t)y * W + x;
                const float* p = points.data() + 3 * i;
                depth[i] = p[2];
                if (!(p[2] > 0) || x == 0 || y == 0 || x == W - 1 || y == H - 1) continue;
                const float *l = p - 3, *r = p + 3, *o = p - 3 * W, *u = p + 3 * W;
                if (!(std::min(std::min(l[2], r[2]), std::min(o[2], u[2])) > 0)) continue;
                if (!same_surface(l[2], p[2], r[2]) || !same_surface(o[2], p[2], u[2])) continue;
                const float ax = r[0] - l[0], ay = r[1] - l[1], az = r[2] - l[2];
                const float bx = u[0] - o[0], by = u[1] - o[1], bz = u[2] - o[2];
                const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
                const float shortest = footprint * p[2] * p[2];
                if (nx * nx + ny * ny + nz * nz < shortest * shortest) continue;
                const float rx = (x - camera.cx) / camera.fx, ry = (y - camera.cy) / camera.fy;
                const float z = (nx * p[0] + ny * p[1] + nz * p[2]) / (nx * rx + ny * ry + nz);
                // A plane seen edge-on says nothing.
                if (std::fabs(z - p[2]) < MAX_SURFACE_CORRECTION * p[2]) depth[i] = z;
            }
        }
    }
}

void build_model_level(const Pinhole& camera, const float* intensity, const float* depth, float* texture,
                       float* surface) {
    const int W = camera.width, H = camera.height;
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            const size_t i = (size_t)y * W + x;
            float* out = texture + 4 * i;
            float* normal = surface + 4 * i;
            std::fill_n(out, 4, 0.0f);
            std::fill_n(normal, 4, 0.0f);
            if (x == 0 || y == 0 || x == W - 1 || y == H - 1) continue;
            const float z = depth[i], l = depth[i - 1], r = depth[i + 1], o = depth[i - W], u = depth[i + W];
            if (!(std::min(std::min(std::min(z, l), std::min(r, o)), u) > 0)) continue;
            out[0] = intensity[i];
            out[1] = 0.5f * (intensity[i + 1] - intensity[i - 1]);
            out[2] = 0.5f * (intensity[i + W] - intensity[i - W]);
            out[3] = z;
            if (!same_surface(l, z, r) || !same_surface(o, z, u)) continue;
            // Tangents along x and y: d/dx of ((x - cx) / fx z, (y - cy) / fy z, z).
            const float rx = (x - camera.cx) / camera.fx, ry = (y - camera.cy) / camera.fy;
            const float zx = 0.5f * (r - l), zy = 0.5f * (u - o);
            const float ax = z / camera.fx + rx * zx, ay = ry * zx, az = zx;
            const float bx = rx * zy, by = z / camera.fy + ry * zy, bz = zy;
            float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
            const float length = std::sqrt(nx * nx + ny * ny + nz * nz);
            nx /= length;
            ny /= length;
            nz /= length;
            normal[0] = nx;
            normal[1] = ny;
            normal[2] = nz;
            normal[3] = (nx * rx + ny * ry + nz) * z;
        }
    }
}

void halve(int width, int height, const float* intensity, const float* depth, float edge, float* half_intensity,
           float* half_depth) {
    const int W = std::max(1, width / 2), H = std::max(1, height / 2);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < H; ++y) {
        for (int x = 0; x < W; ++x) {
            const int x1 = std::min(2 * x + 1, width - 1), y1 = std::min(2 * y + 1, height - 1);
            const size_t taps[4] = {(size_t)(2 * y) * width + 2 * x, (size_t)(2 * y) * width + x1,
                                    (size_t)y1 * width + 2 * x, (size_t)y1 * width + x1};
            float sum = 0, of_surface = 0, nearest = 1e30f, inverse = 0;
            int count = 0;
            for (size_t tap : taps) {
                sum += intensity[tap];
                if (depth[tap] > 0) nearest = std::min(nearest, depth[tap]);
            }
            // Average the nearest surface alone: never mix across an edge, nor with a hole.
            for (size_t tap : taps) {
                if (depth[tap] > 0 && depth[tap] - nearest <= edge * nearest) {
                    of_surface += intensity[tap];
                    inverse += 1.0f / depth[tap];
                    ++count;
                }
            }
            half_intensity[(size_t)y * W + x] = count ? of_surface / count : 0.25f * sum;
            half_depth[(size_t)y * W + x] = count ? count / inverse : 0.0f;
        }
    }
}

}  // namespace semsplat
