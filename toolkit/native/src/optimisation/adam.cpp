// Adam for the visible Gaussians of a view only.
#include "optimisation/adam.hpp"

#include <cmath>

namespace semsplat {

void adam_step(const int64_t* ids, int64_t count, int32_t* steps, const AdamGroup* groups, int group_count,
               const AdamSettings& settings) {
    const float beta1 = settings.beta1, beta2 = settings.beta2;
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < count; ++i) {
        const int64_t id = ids[i];
        const int32_t step = ++steps[id];
        const float correction1 = 1.0f / (1.0f - std::pow(beta1, (float)step));
        const float correction2 = 1.0f / (1.0f - std::pow(beta2, (float)step));
        const float settled = settings.settle_steps > 0 ? 1.0f / (1.0f + step / settings.settle_steps) : 1.0f;
        for (int k = 0; k < group_count; ++k) {
            const AdamGroup& group = groups[k];
            const float unit = group.log_unit ? std::exp(group.log_unit[id]) : 1.0f;
            const float rate = group.learning_rate * settled * unit * correction1;
            const float* g = group.gradient + i * group.width;
            float* p = group.parameter + id * group.width;
            float* m = group.first + id * group.width;
            float* v = group.second + id * group.width;
            for (int j = 0; j < group.width; ++j) {
                // Gradient with respect to the parameter in its unit, so that epsilon has the same scale.
                const float gradient = g[j] * unit;
                m[j] += (1 - beta1) * (gradient - m[j]);
                v[j] += (1 - beta2) * (gradient * gradient - v[j]);
                p[j] -= rate * m[j] / (std::sqrt(v[j] * correction2) + settings.epsilon);
            }
        }
    }
}

}  // namespace semsplat
