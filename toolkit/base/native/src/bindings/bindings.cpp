// Python bindings. Arrays are passed as plain addresses, so that no torch headers are needed.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "alignment/gauss_newton.hpp"
#include "alignment/levels.hpp"
#include "alignment/normal_equations.hpp"
#include "bundle_adjustment/bundle_adjustment.hpp"
#include "depth_filter/depth_filter.hpp"
#include "depth_filter/depth_gaps.hpp"
#include "depth_filter/flying_pixels.hpp"
#include "losses/rgbd_loss.hpp"
#include "losses/semantic_loss.hpp"
#include "losses/ssim.hpp"
#include "mapping/common_cells.hpp"
#include "mapping/depth_confidence.hpp"
#include "mapping/depth_fusion.hpp"
#include "mapping/free_space.hpp"
#include "optimisation/adam.hpp"
#include "plane_sweep/upsampling.hpp"
#include "plane_sweep/consensus.hpp"
#include "plane_sweep/fattening.hpp"
#include "plane_sweep/plane_sweep.hpp"
#include "rendering/splats.hpp"
#include "rendering/surface.hpp"

namespace py = pybind11;

namespace semsplat {
namespace {

typedef uintptr_t Address;

template <class T>
T* at(Address a) {
    return reinterpret_cast<T*>(a);
}

// Means, log radii, opacity logits, colours, features; for ellipsoids also log scales, rotations and
// harmonics, otherwise 0.
typedef std::array<Address, 8> MapArrays;

// counts: Gaussians, feature channels and harmonics.
Gaussians gaussians_at(const std::array<int64_t, 3>& counts, const MapArrays& arrays, bool centres) {
    return {counts[0],
            at<const float>(arrays[0]),
            at<const float>(arrays[1]),
            at<const float>(arrays[2]),
            at<const float>(arrays[3]),
            at<const float>(arrays[4]),
            at<const float>(arrays[5]),
            at<const float>(arrays[6]),
            at<const float>(arrays[7]),
            (int)counts[1],
            (int)counts[2],
            centres};
}

typedef std::array<double, 4> Intrinsics;
typedef std::array<int, 2> Size;

Pinhole pinhole(const Intrinsics& intrinsics, const Size& size) {
    return {(float)intrinsics[0], (float)intrinsics[1], (float)intrinsics[2], (float)intrinsics[3],
            size[0], size[1]};
}

// Projects, bins and composites; `state` is the input of backward.
// low_pass: variance in squared pixels, and whether the opacity is compensated.
void forward(Rasterisation& state, const std::array<int64_t, 3>& counts, const MapArrays& arrays,
             const Intrinsics& intrinsics, const Size& size, const std::array<double, 12>& T_camera_map,
             const std::tuple<double, bool>& low_pass, Address region, bool centres, Address images) {
    const Gaussians map = gaussians_at(counts, arrays, centres);
    state.camera = pinhole(intrinsics, size);
    state.low_pass = {(float)std::get<0>(low_pass), std::get<1>(low_pass)};
    state.shape = map.shape();
    for (int row = 0; row < 3; ++row) {
        for (int k = 0; k < 3; ++k) state.R[3 * row + k] = (float)T_camera_map[4 * row + k];
        state.t[row] = (float)T_camera_map[4 * row + 3];
    }
    state.tiles_x = (size[0] + TILE - 1) / TILE;
    state.tiles_y = (size[1] + TILE - 1) / TILE;
    const py::gil_scoped_release release;
    project(map, state);
    bin(at<const uint8_t>(region), state);
    composite(map, at<const uint8_t>(region), state, at<float>(images));
}

// sinks: gradients of the arrays, those of the colours may be 0, and of T_camera_map (float64).
void backward(const Rasterisation& state, const std::array<int64_t, 3>& counts, const MapArrays& arrays,
              Address region, Address image_gradients, bool detached, const std::array<Address, 9>& sinks) {
    const Gaussians map = gaussians_at(counts, arrays, false);
    const GradientSinks out = {at<float>(sinks[0]), at<float>(sinks[1]), at<float>(sinks[2]),
                               at<float>(sinks[3]), at<float>(sinks[4]), at<float>(sinks[5]),
                               at<float>(sinks[6]), at<float>(sinks[7]), at<double>(sinks[8])};
    const py::gil_scoped_release release;
    differentiate(map, at<const uint8_t>(region), state, at<const float>(image_gradients), detached, out);
}

void copy_visible(const Rasterisation& state, Address ids) {
    int64_t* out = at<int64_t>(ids);
    for (size_t i = 0; i < state.splats.size(); ++i) out[i] = state.splats[i].id;
}

// images, centres: rendered [5, H, W] and [3, H, W]; depth: [H, W].
void depth_of_surface(const Intrinsics& intrinsics, const Size& size, const std::array<double, 12>& T_camera_map,
                      Address images, Address centres, double min_silhouette, Address depth) {
    const py::gil_scoped_release release;
    surface_depth(pinhole(intrinsics, size), T_camera_map.data(), at<const float>(images),
                  at<const float>(centres), (float)min_silhouette, at<float>(depth));
}

// images: rendered [5 + S, H, W]; intensity: [H, W].
void align_intensity(const Size& size, Address images, double min_silhouette, Address intensity) {
    const py::gil_scoped_release release;
    intensity_of(pinhole({1, 1, 0, 0}, size), at<const float>(images), (float)min_silhouette,
                 at<float>(intensity));
}

// images, centres: see depth_of_surface; intensity: [H, W].
void intensity_at_centres(const Intrinsics& intrinsics, const Size& size, const std::array<double, 12>& T_camera_map,
                          Address images, Address centres, double min_silhouette, Address intensity) {
    const py::gil_scoped_release release;
    centred_intensity(pinhole(intrinsics, size), T_camera_map.data(), at<const float>(images),
                      at<const float>(centres), (float)min_silhouette, at<float>(intensity));
}

// rgb, out: [3, H, W].
void sampled_at_centres(const Intrinsics& intrinsics, const Size& size, const std::array<double, 12>& T_camera_map,
                        Address images, Address centres, double min_silhouette, Address rgb, Address out) {
    const py::gil_scoped_release release;
    texture_at_centres(pinhole(intrinsics, size), T_camera_map.data(), at<const float>(images),
                       at<const float>(centres), (float)min_silhouette, at<const float>(rgb), at<float>(out));
}

void align_level(const Intrinsics& intrinsics, const Size& size, Address intensity, Address depth,
                 Address texture, Address surface) {
    const py::gil_scoped_release release;
    build_model_level(pinhole(intrinsics, size), at<const float>(intensity), at<const float>(depth),
                      at<float>(texture), at<float>(surface));
}

void align_halve(const Size& size, Address intensity, Address depth, double max_difference, Address half_intensity,
                 Address half_depth) {
    const py::gil_scoped_release release;
    halve(size[0], size[1], at<const float>(intensity), at<const float>(depth), (float)max_difference,
          at<float>(half_intensity), at<float>(half_depth));
}

// A pyramid level: intrinsics and sizes of the model view's camera, then of the frame's camera; the
// model's texture and surface, the frame's intensity and depth.
typedef std::tuple<std::array<Intrinsics, 2>, std::array<Size, 2>, std::array<Address, 4>> Level;

ModelLevel model_of(const Level& level) {
    const auto& [intrinsics, sizes, arrays] = level;
    return {pinhole(intrinsics[0], sizes[0]), at<const float>(arrays[0]), at<const float>(arrays[1])};
}

FrameLevel frame_of(const Level& level) {
    const auto& [intrinsics, sizes, arrays] = level;
    return {pinhole(intrinsics[1], sizes[1]), at<const float>(arrays[2]), at<const float>(arrays[3])};
}

// scalars: gain, bias, sigma_intensity, sigma_depth, max_distance, photometric_weight. out: 49 doubles.
void align_accumulate(const Level& level, const std::array<double, 12>& T_model_frame,
                      const std::array<double, 6>& scalars, Address out) {
    const ModelLevel model = model_of(level);
    const FrameLevel frame = frame_of(level);
    AlignmentSettings settings;
    std::copy(T_model_frame.begin(), T_model_frame.end(), settings.T_model_frame);
    settings.gain = scalars[0];
    settings.bias = scalars[1];
    settings.sigma_intensity = scalars[2];
    settings.sigma_depth = scalars[3];
    settings.max_distance = scalars[4];
    settings.photometric_weight = scalars[5];
    const py::gil_scoped_release release;
    accumulate(model, frame, settings, *at<NormalEquations>(out));
}

// levels: from fine to coarse. T_model_frame, scalars, out: as for align_accumulate, without the last
// two scalars. limits: iterations per level, residuals. settings: max_distance, photometric_weight,
// min_translation, min_rotation. prior: exposure, or none to keep it fixed. Returns the pose; gain,
// bias and both sigmas; the number of iterations; whether it converged.
std::tuple<std::array<double, 12>, std::array<double, 4>, int, bool> align_pose(
    const std::vector<Level>& levels, const std::array<double, 12>& T_model_frame,
    const std::array<double, 4>& scalars, const std::array<int, 2>& limits, const std::array<double, 4>& settings,
    const std::optional<std::array<double, 2>>& prior, Address out) {
    std::vector<ModelLevel> models;
    std::vector<FrameLevel> frames;
    for (const Level& level : levels) {
        models.push_back(model_of(level));
        frames.push_back(frame_of(level));
    }
    const auto [prior_gain, prior_bias] = prior.value_or(std::array<double, 2>{1, 0});
    const GaussNewtonSettings all = {limits[0],   limits[1],         settings[0], settings[1], settings[2],
                                     settings[3], prior.has_value(), prior_gain,  prior_bias};
    PoseEstimate estimate = {{}, scalars[0], scalars[1], scalars[2], scalars[3], 0, false, {}};
    std::copy(T_model_frame.begin(), T_model_frame.end(), estimate.T_model_frame);
    {
        const py::gil_scoped_release release;
        align(models.data(), frames.data(), (int)levels.size(), all, estimate);
    }
    *at<NormalEquations>(out) = estimate.last;
    std::array<double, 12> T;
    std::copy(estimate.T_model_frame, estimate.T_model_frame + 12, T.begin());
    const std::array<double, 4> found = {estimate.gain, estimate.bias, estimate.sigma_intensity,
                                         estimate.sigma_depth};
    return {T, found, estimate.iterations, estimate.converged};
}

// groups: (parameter, first moment, second moment, gradient, width, learning rate, log unit or 0).
// settings: both betas, epsilon, settle steps.
void adam(Address ids, int64_t count, Address steps,
          const std::vector<std::tuple<Address, Address, Address, Address, int, double, Address>>& groups,
          const std::array<double, 4>& settings) {
    std::vector<AdamGroup> plain;
    for (const auto& [parameter, first, second, gradient, width, rate, unit] : groups) {
        plain.push_back({at<float>(parameter), at<float>(first), at<float>(second), at<const float>(gradient),
                         width, (float)rate, at<const float>(unit)});
    }
    const py::gil_scoped_release release;
    adam_step(at<const int64_t>(ids), count, at<int32_t>(steps), plain.data(), (int)plain.size(),
              {(float)settings[0], (float)settings[1], (float)settings[2], (float)settings[3]});
}

// inverse, out: [H, W]. limits: noise, slack, minimum fraction, edge.
void smoothed(const Size& size, Address inverse, const std::vector<int>& radii, int radius,
              const std::array<double, 4>& limits, Address out) {
    const py::gil_scoped_release release;
    const DepthFilter filter = {radii.data(), (int)radii.size(), limits[0], limits[1], limits[2], radius, limits[3]};
    smooth_inverse_depth(at<const float>(inverse), size[0], size[1], filter, at<float>(out));
}

void fill_gaps(const Size& size, Address inverse, double max_difference, Address out) {
    const py::gil_scoped_release release;
    fill_depth_gaps(at<const float>(inverse), size[0], size[1], (float)max_difference, at<float>(out));
}

// limits: noise, maximum slope, minimum support, linearity, maximum slope of a line.
int64_t without_flying_pixels(const Size& size, const std::array<Address, 3>& inverse,
                              const std::array<int, 2>& counts, const std::array<double, 5>& limits, Address out) {
    const py::gil_scoped_release release;
    const FlyingPixels flying = {counts[0],        (float)limits[0], (float)limits[1], (float)limits[2],
                                 (float)limits[3], (float)limits[4], counts[1]};
    return remove_flying_pixels({at<const float>(inverse[0]), at<const float>(inverse[1]),
                                 at<const float>(inverse[2]), size[0], size[1]},
                                flying, at<float>(out));
}

DepthView depth_view(const Intrinsics& intrinsics, const Size& size, const std::array<double, 12>& T_camera_points,
                     Address empty, double min_depth) {
    DepthView view = {pinhole(intrinsics, size), {}, at<const float>(empty), (float)min_depth};
    for (int k = 0; k < 12; ++k) view.T_camera_points[k] = (float)T_camera_points[k];
    return view;
}

// images: depth, empty depth, confidence. limits: minimum depth, margin, margin as a fraction.
// sums: through, support, nearest.
void add_evidence_of(Address points, int64_t count, const Intrinsics& intrinsics, const Size& size,
                     const std::array<double, 12>& T_camera_points, const std::array<Address, 3>& images,
                     const std::array<double, 3>& limits, bool weighted, const std::array<Address, 3>& sums) {
    const py::gil_scoped_release release;
    const MeasuredDepth measured = {at<const float>(images[0]), at<const float>(images[2]), (float)limits[1],
                                    (float)limits[2]};
    add_evidence(at<const float>(points), count,
                 depth_view(intrinsics, size, T_camera_points, images[1], limits[0]), measured, weighted,
                 {at<float>(sums[0]), at<float>(sums[1]), at<float>(sums[2])});
}

void mark_empty_of(Address points, int64_t count, const Intrinsics& intrinsics, const Size& size,
                   const std::array<double, 12>& T_camera_points, Address empty, double min_depth, Address marks) {
    const py::gil_scoped_release release;
    mark_empty(at<const float>(points), count, depth_view(intrinsics, size, T_camera_points, empty, min_depth),
               at<uint8_t>(marks));
}

// limits: maximum difference of depths, minimum cosine.
void common_cells(Address points, int64_t count, const std::array<double, 12>& T_old_new,
                  const Intrinsics& intrinsics, const Size& size, Address depth, int cell_size,
                  const std::array<double, 2>& limits, Address cells) {
    const py::gil_scoped_release release;
    find_common_cells(at<const double>(points), count, T_old_new.data(),
                      {pinhole(intrinsics, size), at<const float>(depth), cell_size}, {limits[0], limits[1]},
                      at<int32_t>(cells));
}

// limits: focal lengths, depth with full confidence, confidence of grazing angles.
void confidence_of_depth(Address depth, const Size& size, const std::array<double, 4>& limits,
                         Address confidence) {
    const py::gil_scoped_release release;
    depth_confidence(at<const float>(depth), size[0], size[1],
                     {(float)limits[0], (float)limits[1], (float)limits[2], (float)limits[3]},
                     at<float>(confidence));
}

// keyframes: indices, positions. limits: as FusionLimits.
void fuse_measured_depth(const std::array<Address, 2>& gaussians, int64_t count, Address depth,
                         const Intrinsics& intrinsics, const Size& size,
                         const std::array<double, 12>& T_camera_map, const std::array<double, 3>& position,
                         const std::array<Address, 2>& keyframes, int64_t keyframe_count,
                         const std::array<double, 6>& limits) {
    const py::gil_scoped_release release;
    MeasuringView view = {pinhole(intrinsics, size), at<const float>(depth), {}, {}};
    std::copy(T_camera_map.begin(), T_camera_map.end(), view.T_camera_map);
    std::copy(position.begin(), position.end(), view.position);
    fuse_depth(at<float>(gaussians[0]), at<int32_t>(gaussians[1]), count, view,
               {at<const int32_t>(keyframes[0]), at<const float>(keyframes[1]), keyframe_count},
               {(float)limits[0], (float)limits[1], (float)limits[2], (float)limits[3], (float)limits[4],
                (float)limits[5]});
}

double mean_ssim(Address x, Address y, const std::array<int, 3>& shape, double weight, Address gradient) {
    const py::gil_scoped_release release;
    return ssim(at<const float>(x), at<const float>(y), shape[0], shape[1], shape[2], (float)weight,
                at<float>(gradient));
}

// images: rendered, observed colour, observed depth, surface depth.
// weights: colour, depth, silhouette, structure, colour scale, depth scale, minimum silhouette.
double loss_of_rgbd(const Size& size, const std::array<Address, 4>& images, const std::array<double, 7>& weights,
                    Address gradient) {
    const RgbdLoss loss = {(float)weights[0], (float)weights[1], (float)weights[2], (float)weights[3],
                           (float)weights[4], (float)weights[5], (float)weights[6]};
    const py::gil_scoped_release release;
    return rgbd_loss(at<const float>(images[0]), at<const float>(images[1]), at<const float>(images[2]),
                     at<const float>(images[3]), size[1], size[0], loss, at<float>(gradient));
}

// images: features [S, H, W], silhouette, labels. heads: first channels, widths, weights, targets.
// gradients: with respect to the features, and to the silhouette or 0.
double loss_of_semantics(const Size& size, const std::array<Address, 3>& images, int count,
                         const std::array<Address, 4>& heads, bool bits, double min_silhouette,
                         const std::array<Address, 2>& gradients) {
    const SemanticHeads code = {count, at<const int32_t>(heads[0]), at<const int32_t>(heads[1]),
                                at<const float>(heads[2]), at<const int32_t>(heads[3]), bits};
    const py::gil_scoped_release release;
    return semantic_loss(at<const float>(images[0]), at<const float>(images[1]), at<const int32_t>(images[2]),
                         size[1], size[0], code, (float)min_silhouette, at<float>(gradients[0]),
                         at<float>(gradients[1]));
}

// arrays: T_camera_world, fixed, anchor, anchor_pixel, inverse_depth, prior, landmark, pose, pixel,
// distance. counts: poses, landmarks, observations. limits: Huber's threshold, least inverse depth, least
// decrease. Returns cost before and after, factor of the focal length, its information, the number of
// iterations, and whether they converged.
std::tuple<double, double, double, double, int, bool> adjust_bundle(
    const std::array<Address, 10>& arrays, const std::array<int64_t, 3>& counts, const Intrinsics& intrinsics,
    int iterations, const std::array<double, 3>& limits, bool focal) {
    const Bundle bundle = {(int)counts[0],
                           (int)counts[1],
                           counts[2],
                           at<double>(arrays[0]),
                           at<const uint8_t>(arrays[1]),
                           at<const int32_t>(arrays[2]),
                           at<const double>(arrays[3]),
                           at<double>(arrays[4]),
                           at<const double>(arrays[5]),
                           at<const int32_t>(arrays[6]),
                           at<const int32_t>(arrays[7]),
                           at<const double>(arrays[8]),
                           at<double>(arrays[9])};
    const BundleSettings settings = {intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], iterations,
                                     limits[0],     limits[1],     limits[2],     focal};
    BundleResult result;
    {
        const py::gil_scoped_release release;
        result = adjust(bundle, settings);
    }
    return {result.cost_before, result.cost,       result.focal_factor, result.focal_information,
            result.iterations,  result.converged};
}

typedef std::vector<std::tuple<Address, std::array<double, 12>>> PosedImages;

// sources: intensities and T_source_reference. planes: inverse depths of the first planes, number of
// planes. limits: step between planes, both penalties. out: plane, correlation, margin.
void plane_sweep(const Intrinsics& intrinsics, const Size& size, Address intensity, const PosedImages& sources,
                 const std::pair<Address, int>& planes, const std::array<double, 3>& limits,
                 const std::array<Address, 3>& out) {
    Sweep s = {pinhole(intrinsics, size), at<const float>(intensity), {}, planes.second,
               at<const float>(planes.first), limits[0], limits[1], limits[2]};
    for (const auto& [image, pose] : sources) s.sources.push_back({at<const float>(image), pose});
    const py::gil_scoped_release release;
    sweep(s, {at<float>(out[0]), at<float>(out[1]), at<float>(out[2])});
}

// half: size, intensity and inverse depth of the half image. size: of the image. images: intensity, result.
void double_depth(const std::tuple<Size, Address, Address>& half, const Size& size,
                  const std::array<Address, 2>& images, double max_step) {
    const auto& [half_size, intensity, inverse_depth] = half;
    const HalfDepth from{half_size[0], half_size[1], at<const float>(intensity), at<const float>(inverse_depth)};
    const py::gil_scoped_release release;
    upsample_depth(from, size[0], size[1], at<const float>(images[0]), (float)max_step,
                           at<float>(images[1]));
}

// images: intensity, inverse depth, inverse depth behind depth edges, result.
void remove_fattening_of(const Size& size, const std::array<Address, 4>& images) {
    const MatchedDepth image{size[0], size[1], at<const float>(images[0]), at<const float>(images[1]),
                             at<const float>(images[2])};
    const py::gil_scoped_release release;
    remove_fattening(image, at<float>(images[3]));
}

// others: inverse depths and T_other_reference. limits: tolerance, in_front. out: inverse depth, spread,
// parallax, agreeing, conflicting.
void find_consensus(const Intrinsics& intrinsics, const Size& size, Address inverse_depth, const PosedImages& others,
                    const std::array<double, 2>& limits, const std::array<Address, 5>& out) {
    ConsensusInput input = {pinhole(intrinsics, size), at<const float>(inverse_depth), {}, (float)limits[0],
                            (float)limits[1]};
    for (const auto& [image, pose] : others) input.others.push_back({at<const float>(image), pose});
    const py::gil_scoped_release release;
    compare_depths(input, {at<float>(out[0]), at<float>(out[1]), at<float>(out[2]), at<float>(out[3]),
                                     at<float>(out[4])});
}

// The instruction sets supported by the CPU and the operating system, ascending. The tested features
// are those that setup.py compiles each variant for.
std::vector<std::string> supported_instruction_sets() {
    std::vector<std::string> names = {"base"};
#if defined(__x86_64__)
    // These functions also check that the operating system saves the wider registers.
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
        names.push_back("avx2");
        if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
            __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq")) {
            names.push_back("avx512");
        }
    }
#endif
    return names;
}

}  // namespace
}  // namespace semsplat

#define SEMSPLAT_QUOTED(name) #name
#define SEMSPLAT_NAME(name) SEMSPLAT_QUOTED(name)

PYBIND11_MODULE(SEMSPLAT_INSTRUCTION_SET, m) {
    using namespace semsplat;
    m.doc() = "Native kernels: splat rasterisation, dense alignment, optimisation.";
    // Local to the module: the variants for other instruction sets register their own.
    py::class_<Rasterisation>(m, "Rasterisation", py::module_local(), "State of forward for backward.")
        .def(py::init<>())
        .def_property_readonly("visible", [](const Rasterisation& s) { return s.splats.size(); })
        .def_property_readonly("pairs", [](const Rasterisation& s) { return s.pair_splat.size(); });
    m.def("forward", &forward);
    m.def("backward", &backward);
    m.def("copy_visible", &copy_visible);
    m.def("surface_depth", &depth_of_surface);
    m.def("align_intensity", &align_intensity);
    m.def("centred_intensity", &intensity_at_centres);
    m.def("texture_at_centres", &sampled_at_centres);
    m.def("align_level", &align_level);
    m.def("align_halve", &align_halve);
    m.def("align_accumulate", &align_accumulate);
    m.def("align_pose", &align_pose);
    m.def("adjust_bundle", &adjust_bundle);
    m.def("plane_sweep", &plane_sweep);
    m.def("double_depth", &double_depth);
    m.def("remove_fattening", &remove_fattening_of);
    m.def("find_consensus", &find_consensus);
    m.def("adam", &adam);
    m.def("smooth_inverse_depth", &smoothed);
    m.def("fill_depth_gaps", &fill_gaps);
    m.def("remove_flying_pixels", &without_flying_pixels);
    m.def("add_evidence", &add_evidence_of);
    m.def("mark_empty", &mark_empty_of);
    m.def("find_common_cells", &common_cells);
    m.def("depth_confidence", &confidence_of_depth);
    m.def("fuse_depth", &fuse_measured_depth);
    m.def("mean_ssim", &mean_ssim);
    m.def("rgbd_loss", &loss_of_rgbd);
    m.def("semantic_loss", &loss_of_semantics);
    m.def("supported_instruction_sets", &supported_instruction_sets);
    m.attr("constants") = SEMSPLAT_CONSTANTS;
    m.attr("instruction_set") = SEMSPLAT_NAME(SEMSPLAT_INSTRUCTION_SET);
}
