// Runs every native kernel on small generated inputs and prints the results.
//
// It needs no Python, so that kernels can be run on other architectures under emulation. Each line
// is the name of an output, then values: its sum, its sum of squares, and eight samples of it.
#include <cmath>
#include <cstdio>
#include <vector>

#include "alignment/gauss_newton.hpp"
#include "alignment/normal_equations.hpp"
#include "bundle_adjustment/bundle_adjustment.hpp"
#include "common/constants.hpp"
#include "depth_filter/depth_filter.hpp"
#include "losses/rgbd_loss.hpp"
#include "losses/semantic_loss.hpp"
#include "losses/ssim.hpp"
#include "optimisation/adam.hpp"
#include "plane_sweep/consensus.hpp"
#include "plane_sweep/plane_sweep.hpp"
#include "plane_sweep/upsampling.hpp"
#include "rendering/splats.hpp"
#include "rendering/surface.hpp"

using namespace semsplat;

namespace {

// A linear congruential generator: the same numbers everywhere.
struct Random {
    uint32_t state = 1;
    float operator()(float low, float high) {
        state = 1664525u * state + 1013904223u;
        return low + (high - low) * (float)(state >> 8) / 16777216.0f;
    }
};

template <class T>
void print(const char* name, const T* values, size_t count) {
    double sum = 0, squares = 0;
    for (size_t i = 0; i < count; ++i) {
        sum += values[i];
        squares += (double)values[i] * values[i];
    }
    std::printf("%s %.9g %.9g", name, sum, squares);
    for (size_t k = 0; k < 8; ++k) std::printf(" %.9g", (double)values[k * (count - 1) / 7]);
    std::printf("\n");
}

template <class T>
void print(const char* name, const std::vector<T>& values) {
    print(name, values.data(), values.size());
}

enum { WIDTH = 53, HEIGHT = 38, PIXELS = WIDTH * HEIGHT, COUNT = 900 };
const Pinhole CAMERA{48.0f, 47.0f, 26.0f, 19.5f, WIDTH, HEIGHT};
const double POSE[12] = {1, 0, 0, 0.02, 0, 1, 0, -0.01, 0, 0, 1, 0.03};

struct Scene {
    enum { HARMONICS = 8 };
    std::vector<float> means, log_radii, logits, colours, features, log_scales, rotations, harmonics;
    Scene(int channels) {
        Random random;
        for (int i = 0; i < COUNT; ++i) {
            const float z = random(1.0f, 3.0f);
            means.push_back(random(-0.6f, 0.6f) * z);
            means.push_back(random(-0.45f, 0.45f) * z);
            means.push_back(z);
            log_radii.push_back(std::log(random(0.5f, 4.0f) * z / 48.0f));
            logits.push_back(random(-4.0f, 6.0f));
            for (int c = 0; c < 3; ++c) colours.push_back(random(0.0f, 1.0f));
            for (int c = 0; c < channels; ++c) features.push_back(random(-1.0f, 1.0f));
        }
        for (float log_radius : log_radii) {
            for (int k = 0; k < 3; ++k) log_scales.push_back(log_radius + random(-1.0f, 0.5f));
            for (int k = 0; k < 4; ++k) rotations.push_back(random(-1.0f, 1.0f));
            for (int k = 0; k < 3 * HARMONICS; ++k) harmonics.push_back(random(-0.2f, 0.2f));
        }
    }
    Gaussians gaussians(int channels, bool centres, Shape shape = Shape::SPHERE) const {
        const bool spheres = shape == Shape::SPHERE;
        return {COUNT,
                means.data(),
                log_radii.data(),
                logits.data(),
                colours.data(),
                features.data(),
                spheres ? nullptr : log_scales.data(),
                spheres ? nullptr : rotations.data(),
                spheres ? nullptr : harmonics.data(),
                channels,
                spheres ? 0 : HARMONICS,
                centres};
    }
};

void start(Rasterisation& state, const Gaussians& map) {
    state.camera = CAMERA;
    state.shape = map.shape();
    if (state.shape == Shape::ELLIPSOID) state.low_pass = {0.1f, true};
    state.tiles_x = (WIDTH + TILE - 1) / TILE;
    state.tiles_y = (HEIGHT + TILE - 1) / TILE;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) state.R[3 * i + j] = (float)POSE[4 * i + j];
        state.t[i] = (float)POSE[4 * i + 3];
    }
    project(map, state);
    bin(nullptr, state);
}

void rendering(int channels, Shape shape = Shape::SPHERE) {
    const Scene scene(channels);
    const Gaussians map = scene.gaussians(channels, false, shape);
    const char* const kind = shape == Shape::SPHERE ? "" : "ellipsoids-";
    Rasterisation state;
    start(state, map);
    std::vector<float> images((size_t)(BASE_CHANNELS + channels) * PIXELS);
    composite(map, nullptr, state, images.data());
    std::printf("%schannels-%d-", kind, channels);
    print("images", images);

    Random random;
    std::vector<float> gradients(images.size());
    for (float& g : gradients) g = random(-1.0f, 1.0f);
    const size_t visible = state.splats.size();
    for (const bool detached : {false, true}) {
        std::vector<float> means(3 * visible), radii(visible), logits(visible), colours(3 * visible),
            features(visible * channels), scales(3 * visible), rotations(4 * visible),
            harmonics(3 * Scene::HARMONICS * visible);
        std::vector<double> pose(12);
        differentiate(map, nullptr, state, gradients.data(), detached,
                      {means.data(), radii.data(), logits.data(), colours.data(), features.data(), scales.data(),
                       rotations.data(), harmonics.data(), pose.data()});
        const auto show = [&](const char* name, const auto& values) {
            std::printf("%schannels-%d-%s-", kind, channels, detached ? "detached" : "joint");
            print(name, values);
        };
        show("means", means);
        if (shape == Shape::SPHERE) {
            show("radii", radii);
        } else {
            show("scales", scales);
            show("rotations", rotations);
            show("harmonics", harmonics);
        }
        show("opacities", logits);
        show("colours", colours);
        show("pose", pose);
        if (channels) {
            show("features", features);
        }
    }
}

void surfaces_and_losses() {
    const int channels = 11;
    const Scene scene(channels);
    const Gaussians map = scene.gaussians(channels, true);
    Rasterisation state;
    start(state, map);
    std::vector<float> images((size_t)(BASE_CHANNELS + channels + 3) * PIXELS);
    composite(map, nullptr, state, images.data());
    const float* const centres = images.data() + (size_t)(BASE_CHANNELS + channels) * PIXELS;
    std::vector<float> depth(PIXELS), intensity(PIXELS), moved((size_t)3 * PIXELS), rgb((size_t)3 * PIXELS);
    Random random;
    for (float& value : rgb) value = random(0.0f, 1.0f);
    surface_depth(CAMERA, POSE, images.data(), centres, 0.5f, depth.data());
    print("surface-depth", depth);
    centred_intensity(CAMERA, POSE, images.data(), centres, 0.5f, intensity.data());
    print("centred-intensity", intensity);
    texture_at_centres(CAMERA, POSE, images.data(), centres, 0.5f, rgb.data(), moved.data());
    print("texture-at-centres", moved);

    std::vector<float> measured(depth), gradient((size_t)BASE_CHANNELS * PIXELS);
    for (float& z : measured) z *= random(0.95f, 1.05f);
    const RgbdLoss weights{0.6f, 1.0f, 0.1f, 0.2f, 0.1f, 0.01f, 0.5f};
    double value = rgbd_loss(images.data(), rgb.data(), measured.data(), depth.data(), HEIGHT, WIDTH, weights,
                             gradient.data());
    print("rgbd-loss", &value, 1);
    print("rgbd-gradient", gradient);

    const int32_t first[] = {0, 3, 7}, width[] = {3, 4, 4};
    const float head_weights[] = {1.0f, 0.7f, 0.4f};
    const int32_t targets[] = {0, 1, 2, 1, 3, 0, 2, 0, 3, 1, 2, 1};
    std::vector<int32_t> labels(PIXELS);
    for (int i = 0; i < PIXELS; ++i) labels[(size_t)i] = (i / 7) % 5;
    for (const bool bits : {false, true}) {
        const SemanticHeads heads{3, first, width, head_weights, targets, bits};
        std::vector<float> by_features((size_t)channels * PIXELS), by_silhouette(PIXELS, 0.0f);
        value = semantic_loss(images.data() + (size_t)BASE_CHANNELS * PIXELS, images.data() + (size_t)SILHOUETTE * PIXELS,
                              labels.data(), HEIGHT, WIDTH, heads, 0.5f, by_features.data(), by_silhouette.data());
        std::printf("semantic-%s-", bits ? "bits" : "one-hot");
        print("loss", &value, 1);
        std::printf("semantic-%s-", bits ? "bits" : "one-hot");
        print("features", by_features);
        std::printf("semantic-%s-", bits ? "bits" : "one-hot");
        print("silhouette", by_silhouette);
    }
}

// A tilted plane with a pattern and a step.
void fill_view(std::vector<float>& intensity, std::vector<float>& depth, float shift) {
    for (int y = 0; y < HEIGHT; ++y) {
        for (int x = 0; x < WIDTH; ++x) {
            const size_t i = (size_t)y * WIDTH + x;
            intensity[i] = 0.5f + 0.2f * std::sin(0.35f * (x + shift)) + 0.2f * std::cos(0.3f * y);
            depth[i] = x > 38 ? 2.6f : 1.5f + 0.01f * (x + shift) + 0.005f * y;
        }
    }
}

void alignment() {
    std::vector<float> intensity(PIXELS), depth(PIXELS), texture((size_t)4 * PIXELS), surface((size_t)4 * PIXELS);
    fill_view(intensity, depth, 0.0f);
    build_model_level(CAMERA, intensity.data(), depth.data(), texture.data(), surface.data());
    print("level-texture", texture);
    print("level-surface", surface);
    fill_view(intensity, depth, 0.3f);
    for (size_t i = 0; i < depth.size(); i += 17) depth[i] = 0.0f;
    AlignmentSettings settings{{}, 1.05, -0.02, 0.05, 0.01, 0.2, 0.5};
    for (int k = 0; k < 12; ++k) settings.T_model_frame[k] = POSE[k];
    NormalEquations found;
    accumulate({CAMERA, texture.data(), surface.data()}, {CAMERA, intensity.data(), depth.data()}, settings, found);
    print("normal-equations-H", found.H, NORMAL_SIZE);
    print("normal-equations-g", found.g, PARAMETERS);
    const double counts[] = {found.intensity_pixels, found.depth_pixels, found.intensity_squares,
                             found.depth_squares, found.frame_pixels};
    print("normal-equations-sums", counts, 5);
    const ModelLevel model{CAMERA, texture.data(), surface.data()};
    const FrameLevel frame{CAMERA, intensity.data(), depth.data()};
    PoseEstimate estimate{{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0}, 1, 0, 0.05, 0.01, 0, false, {}};
    align(&model, &frame, 1, {20, 100, 0.2, 0.5, 1e-5, 1e-5, true, 1, 0}, estimate);
    print("aligned-pose", estimate.T_model_frame, 12);
    std::vector<float> half_intensity(PIXELS / 4), half_depth(PIXELS / 4);
    halve(WIDTH, HEIGHT, intensity.data(), depth.data(), 0.05f, half_intensity.data(), half_depth.data());
    const size_t half = (size_t)(WIDTH / 2) * (HEIGHT / 2);
    print("half-intensity", half_intensity.data(), half);
    print("half-depth", half_depth.data(), half);
}

void depth_filter() {
    Random random;
    std::vector<float> inverse(PIXELS), smooth(PIXELS);
    for (int i = 0; i < PIXELS; ++i) {
        const bool missing = random(0.0f, 1.0f) < 0.05f;
        inverse[(size_t)i] = missing ? 0.0f : 1.0f / (1.5f + 0.01f * (i % WIDTH)) + random(-0.002f, 0.002f);
    }
    const int radii[] = {7, 4, 2};
    smooth_inverse_depth(inverse.data(), WIDTH, HEIGHT, {radii, 3, 0.0015, 3.0, 0.5, 3, 0.01}, smooth.data());
    print("smooth-inverse-depth", smooth);
}

void adam() {
    Random random;
    enum { ROWS = 300, WIDE = 3 };
    std::vector<float> parameter(ROWS * WIDE), first(ROWS * WIDE), second(ROWS * WIDE), gradient(ROWS * WIDE),
        log_unit(ROWS);
    std::vector<int64_t> ids;
    std::vector<int32_t> steps(ROWS);
    for (int i = 0; i < ROWS; ++i) {
        if (i % 3 || i > 100) ids.push_back(i);
    }
    for (float& value : parameter) value = random(-1.0f, 1.0f);
    for (float& value : log_unit) value = random(-4.0f, -2.0f);
    const AdamGroup group{parameter.data(), first.data(), second.data(), gradient.data(), WIDE, 0.01f, log_unit.data()};
    for (int step = 0; step < 5; ++step) {
        for (float& value : gradient) value = random(-1.0f, 1.0f);
        adam_step(ids.data(), (int64_t)ids.size(), steps.data(), &group, 1, {0.9f, 0.99f, 1e-8f, 50.0f});
    }
    print("adam", parameter);
}

// A camera that moves sideways past points: poses and inverse depths from their pixels.
void bundle_adjustment() {
    enum { POSES = 4, LANDMARKS = 40 };
    Random random;
    std::vector<double> T, anchor_pixel, inverse_depth, prior(2 * LANDMARKS), pixel;
    std::vector<int32_t> anchor(LANDMARKS), landmark, pose;
    const uint8_t fixed[POSES] = {1, 1, 0, 0};
    for (int p = 0; p < POSES; ++p) {
        const double wrong = fixed[p] ? 0 : 0.02;
        for (double value : {1.0, 0.0, 0.0, -0.1 * p + wrong, 0.0, 1.0, 0.0, wrong, 0.0, 0.0, 1.0, 0.0}) T.push_back(value);
    }
    for (int l = 0; l < LANDMARKS; ++l) {
        const double u = random(5.0f, 45.0f), v = random(5.0f, 33.0f), q = random(0.3f, 0.9f);
        anchor_pixel.insert(anchor_pixel.end(), {u, v});
        inverse_depth.push_back(1.2 * q);
        for (int p = 1; p < POSES; ++p) {
            landmark.push_back(l);
            pose.push_back(p);
            pixel.insert(pixel.end(), {u - 48.0 * 0.1 * p * q, v});
        }
    }
    std::vector<double> distance(landmark.size());
    const Bundle bundle{POSES, LANDMARKS, (int64_t)landmark.size(), T.data(), fixed, anchor.data(), anchor_pixel.data(),
                        inverse_depth.data(), prior.data(), landmark.data(), pose.data(), pixel.data(), distance.data()};
    adjust(bundle, {48.0, 47.0, 26.0, 19.5, 30, 1.0, 1e-4, 1e-9, false});
    print("bundle-poses", T);
    print("bundle-inverse-depth", inverse_depth);
}

void plane_sweep() {
    std::vector<float> reference(PIXELS), source(PIXELS), plane(PIXELS), correlation(PIXELS), margin(PIXELS);
    // A wall in front of a camera that moves to the right by 0.1: its image moves by 2.4 pixels.
    const auto pattern = [](float x, float y) { return 0.5f + 0.2f * std::sin(0.9f * x) + 0.2f * std::cos(0.7f * y + 0.3f * x); };
    for (int i = 0; i < PIXELS; ++i) {
        const float x = (float)(i % WIDTH), y = (float)(i / WIDTH);
        reference[(size_t)i] = pattern(x, y);
        source[(size_t)i] = pattern(x + 2.4f, y);
    }
    const std::array<double, 12> moved = {1, 0, 0, -0.1, 0, 1, 0, 0, 0, 0, 1, 0};
    const std::vector<float> first(PIXELS, 0.1f);
    sweep({CAMERA, reference.data(), {{source.data(), moved}}, 17, first.data(), 0.05, 0.04, 0.4},
          {plane.data(), correlation.data(), margin.data()});
    print("swept-plane", plane);
    print("swept-correlation", correlation);
    std::vector<float> inverse(PIXELS), doubled((size_t)4 * PIXELS), large((size_t)4 * PIXELS, 0.5f);
    for (int i = 0; i < PIXELS; ++i) inverse[(size_t)i] = 0.1f + 0.05f * plane[(size_t)i];
    upsample_depth({WIDTH, HEIGHT, reference.data(), inverse.data()}, 2 * WIDTH, 2 * HEIGHT, large.data(), 0.1f,
                   doubled.data());
    print("upsampled-depth", doubled);
    std::vector<float> wall(PIXELS, 0.5f), fused(PIXELS), spread(PIXELS), parallax(PIXELS), agreeing(PIXELS),
        conflicting(PIXELS);
    compare_depths({CAMERA, wall.data(), {{wall.data(), moved}, {inverse.data(), moved}}, 0.2f, 0.5f},
                   {fused.data(), spread.data(), parallax.data(), agreeing.data(), conflicting.data()});
    print("fused-depth", fused);
    print("parallax", parallax);
}

}  // namespace

int main() {
    for (const int channels : {0, 1, 3, 6, 9, 20, 35}) rendering(channels);
    for (const int channels : {0, 5}) rendering(channels, Shape::ELLIPSOID);
    surfaces_and_losses();
    alignment();
    depth_filter();
    adam();
    bundle_adjustment();
    plane_sweep();
    return 0;
}
