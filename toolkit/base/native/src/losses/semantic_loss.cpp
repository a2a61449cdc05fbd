#include "losses/semantic_loss.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "common/simd.hpp"

namespace semsplat {
namespace {

enum { LANE = 16, CHUNK = 64 };

struct Lanes {
    alignas(64) float inverse[LANE];   // 1 / silhouette, 0 for inactive pixels
    alignas(64) float active[LANE];    // 1 or 0
    alignas(64) float value_gradient[LANE];  // sum of gradient * value, for the gradient of the silhouette
    alignas(64) float target[LANE];    // an integer
};

// 1 where a target is a channel, else 0.
SEMSPLAT_INLINE Floats is_target(Floats target, int channel) {
    return keep(both(ge(target, all((float)channel)), lt(target, all((float)(channel + 1)))), all(1.0f));
}

// Softmax head of sixteen pixels (H-10): writes its gradient, adds each pixel's loss to `value`.
void softmax_head(const float* features, size_t plane, int channels, float weight, Lanes& lanes, float* scratch,
                  float* gradient, float* value) {
    for (int first = 0; first < LANE; first += LANES) {
        const float* const from = features + first;
        const Floats inverse = load(lanes.inverse + first), target = load(lanes.target + first);
        Floats most = load(from) * inverse;
        for (int c = 1; c < channels; ++c) most = maximum(most, load(from + c * plane) * inverse);
        Floats sum = all(0.0f);
        for (int c = 0; c < channels; ++c) {
            const Floats e = exp_negative(load(from + c * plane) * inverse - most);
            store(scratch + LANES * c, e);
            sum = sum + e;
        }
        const Floats by_sum = all(1.0f) / sum, scale = all(weight) * inverse;
        Floats of_target = all(0.0f), by_value = load(lanes.value_gradient + first);
        for (int c = 0; c < channels; ++c) {
            const Floats z = load(from + c * plane) * inverse, one = is_target(target, c);
            const Floats d = scale * fma(load(scratch + LANES * c), by_sum, all(0.0f) - one);
            of_target = fma(one, z, of_target);
            by_value = fma(d, z, by_value);
            store(gradient + c * plane + first, d);
        }
        const Floats loss = logarithm(sum) + most - of_target;
        store(lanes.value_gradient + first, by_value);
        store(value + first, fma(all(weight) * load(lanes.active + first), loss, load(value + first)));
    }
}

// Binary head of sixteen pixels (H-11).
void bits_head(const float* features, size_t plane, int channels, float weight, Lanes& lanes, float*,
               float* gradient, float* value) {
    for (int c = 0; c < channels; ++c) {
        alignas(64) float magnitude[LANE], e[LANE], grown[LANE], logs[LANE];
        for (int i = 0; i < LANE; ++i) magnitude[i] = -std::fabs(features[c * plane + i] * lanes.inverse[i]);
        for (int i = 0; i < LANE; i += LANES) store(e + i, exp_negative(load(magnitude + i)));
        for (int i = 0; i < LANE; ++i) grown[i] = 1.0f + e[i];
        for (int i = 0; i < LANE; i += LANES) store(logs + i, logarithm(load(grown + i)));
        for (int i = 0; i < LANE; ++i) {
            const float z = features[c * plane + i] * lanes.inverse[i];
            const float bit = (float)(((int32_t)lanes.target[i] >> c) & 1);
            value[i] += weight * lanes.active[i] * (logs[i] + std::max(z, 0.0f) - bit * z);
            const float p = (z >= 0 ? 1.0f : e[i]) / grown[i];
            const float d = weight * lanes.inverse[i] * (p - bit);
            lanes.value_gradient[i] += d * z;
            gradient[c * plane + i] = d;
        }
    }
}

// Sixteen neighbouring pixels; `stride` is the distance between their channels in floats.
struct Patch {
    const float* features;
    const float* silhouette;
    const int32_t* labels;
    size_t stride;
    float* gradient;
    float* silhouette_gradient;  // can be null
};

// Computes the loss of a patch and writes its gradients.
double patch_loss(const Patch& patch, const SemanticHeads& heads, int channels, float min_silhouette,
                  float* scratch) {
    // The channels are more streams than the processor can predict.
    for (int c = 0; c < channels; ++c) {
        __builtin_prefetch(patch.features + c * patch.stride + 2 * LANE);
        __builtin_prefetch(patch.gradient + c * patch.stride + 2 * LANE, 1);
    }
    Lanes lanes;
    alignas(64) float value[LANE] = {0};
    bool any = false;
    for (int i = 0; i < LANE; ++i) {
        const bool active = patch.labels[i] > 0 && patch.silhouette[i] >= min_silhouette;
        lanes.active[i] = active ? 1.0f : 0.0f;
        lanes.inverse[i] = active ? 1.0f / patch.silhouette[i] : 0.0f;
        lanes.value_gradient[i] = 0;
        any |= active;
    }
    if (!any) {
        for (int c = 0; c < channels; ++c) std::fill_n(patch.gradient + c * patch.stride, (int)LANE, 0.0f);
        return 0.0;
    }
    const auto head = heads.bits ? bits_head : softmax_head;
    for (int h = 0; h < heads.count; ++h) {
        for (int i = 0; i < LANE; ++i) {
            const int32_t label = patch.labels[i];
            lanes.target[i] = label > 0 ? (float)heads.targets[(label - 1) * heads.count + h] : 0.0f;
        }
        const size_t at = heads.first[h] * patch.stride;
        head(patch.features + at, patch.stride, heads.width[h], heads.weight[h], lanes, scratch,
             patch.gradient + at, value);
    }
    double total = 0;
    for (int i = 0; i < LANE; ++i) {
        total += value[i];
        if (patch.silhouette_gradient) patch.silhouette_gradient[i] -= lanes.value_gradient[i];
    }
    return total;
}

// The last pixels of an image, padded with void pixels to a multiple of sixteen.
double rest_loss(const Patch& image, int64_t rest, const SemanticHeads& heads, int channels,
                 float min_silhouette, float* scratch) {
    std::vector<float> features((size_t)channels * LANE, 0.0f), gradient(features.size(), 0.0f);
    float silhouette[LANE] = {0}, silhouette_gradient[LANE] = {0};
    int32_t labels[LANE] = {0};
    std::copy_n(image.silhouette, rest, silhouette);
    std::copy_n(image.labels, rest, labels);
    for (int c = 0; c < channels; ++c) {
        std::copy_n(image.features + c * image.stride, rest, features.data() + c * LANE);
    }
    const Patch padded = {features.data(), silhouette, labels, LANE, gradient.data(), silhouette_gradient};
    const double total = patch_loss(padded, heads, channels, min_silhouette, scratch);
    for (int c = 0; c < channels; ++c) {
        std::copy_n(gradient.data() + c * LANE, rest, image.gradient + c * image.stride);
    }
    for (int64_t i = 0; image.silhouette_gradient && i < rest; ++i) image.silhouette_gradient[i] += silhouette_gradient[i];
    return total;
}

}  // namespace

double semantic_loss(const float* features, const float* silhouette, const int32_t* labels, int height, int width,
                     const SemanticHeads& heads, float min_silhouette, float* gradient,
                     float* silhouette_gradient) {
    const int64_t plane = (int64_t)height * width, patches = plane / LANE, rest = plane - patches * LANE;
    const int64_t chunks = (patches + CHUNK - 1) / CHUNK;
    int channels = 0, widest = 1;
    for (int h = 0; h < heads.count; ++h) {
        channels = std::max(channels, heads.first[h] + heads.width[h]);
        widest = std::max(widest, heads.width[h]);
    }
    const auto patch_at = [&](int64_t p) {
        return Patch{features + p, silhouette + p, labels + p, (size_t)plane, gradient + p,
                     silhouette_gradient ? silhouette_gradient + p : nullptr};
    };
    // Summed in a fixed order, independent of the number of threads.
    std::vector<double> by_chunk((size_t)chunks + 1, 0.0);
#pragma omp parallel
    {
        std::vector<float> scratch((size_t)widest * LANE);
#pragma omp for schedule(static)
        for (int64_t k = 0; k < chunks; ++k) {
            for (int64_t at = k * CHUNK; at < std::min(patches, (k + 1) * CHUNK); ++at) {
                by_chunk[k] += patch_loss(patch_at(at * LANE), heads, channels, min_silhouette, scratch.data());
            }
        }
    }
    if (rest) {
        std::vector<float> scratch((size_t)widest * LANE);
        by_chunk[chunks] = rest_loss(patch_at(patches * LANE), rest, heads, channels, min_silhouette, scratch.data());
    }
    double total = 0;
    for (double value : by_chunk) total += value;
    return total;
}

}  // namespace semsplat
