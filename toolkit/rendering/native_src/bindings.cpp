// The door to Python: plain addresses in, so that no torch headers are needed.
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>

#include "splats.hpp"

namespace py = pybind11;

namespace semsplat {
namespace {

typedef uintptr_t Address;

template <class T>
T* at(Address a) {
    return reinterpret_cast<T*>(a);
}

Gaussians gaussians_at(int64_t count, const std::array<Address, 5>& arrays, int feature_channels) {
    return {count,
            at<const float>(arrays[0]),
            at<const float>(arrays[1]),
            at<const float>(arrays[2]),
            at<const float>(arrays[3]),
            at<const float>(arrays[4]),
            feature_channels};
}

// Sorts, bins and composites; `state` is what backward needs.
void forward(Rasterisation& state, int64_t count, const std::array<Address, 5>& arrays, int feature_channels,
             const std::array<double, 4>& intrinsics, const std::array<int, 2>& size,
             const std::array<double, 12>& T_camera_map, Address region, Address images) {
    const Gaussians map = gaussians_at(count, arrays, feature_channels);
    state.camera = {(float)intrinsics[0], (float)intrinsics[1], (float)intrinsics[2],
                    (float)intrinsics[3], size[0], size[1]};
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

// sinks: means, log radii, opacity logits, colours (or 0), features, T_camera_map (float64).
void backward(const Rasterisation& state, int64_t count, const std::array<Address, 5>& arrays,
              int feature_channels, Address region, Address image_gradients, const std::array<Address, 6>& sinks) {
    const Gaussians map = gaussians_at(count, arrays, feature_channels);
    const GradientSinks out = {at<float>(sinks[0]), at<float>(sinks[1]), at<float>(sinks[2]),
                               at<float>(sinks[3]), at<float>(sinks[4]), at<double>(sinks[5])};
    const py::gil_scoped_release release;
    differentiate(map, at<const uint8_t>(region), state, at<const float>(image_gradients), out);
}

void copy_visible(const Rasterisation& state, Address ids) {
    int64_t* out = at<int64_t>(ids);
    for (size_t i = 0; i < state.splats.size(); ++i) out[i] = state.splats[i].id;
}

// The best instruction set that this processor runs and that we build for.
std::string instruction_set() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq")) {
        return "avx512";
    }
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return "avx2";
#endif
    return "base";
}

}  // namespace
}  // namespace semsplat

PYBIND11_MODULE(SEMSPLAT_MODULE, m) {
    using namespace semsplat;
    m.doc() = "Native kernels: splat rasterisation, dense alignment, optimisation.";
    // Local to the module: the variants for other instruction sets register their own.
    py::class_<Rasterisation>(m, "Rasterisation", py::module_local(), "What forward leaves for backward.")
        .def(py::init<>())
        .def_property_readonly("visible", [](const Rasterisation& s) { return s.splats.size(); })
        .def_property_readonly("pairs", [](const Rasterisation& s) { return s.pair_splat.size(); });
    m.def("forward", &forward);
    m.def("backward", &backward);
    m.def("copy_visible", &copy_visible);
    m.def("instruction_set", &instruction_set);
}
