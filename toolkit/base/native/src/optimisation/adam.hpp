// Sparse Adam.
#pragma once

#include <cstdint>

namespace semsplat {

// Adam step for the rows `ids` of a parameter [N, width] with compact gradients [V, width].
struct AdamGroup {
    float* parameter;
    float* first;            // running mean of gradients, [N, width]
    float* second;           // running mean of squares, [N, width]
    const float* gradient;   // [V, width]
    int width;
    float learning_rate;
    const float* log_unit;   // [N] or null: learning rates in units of exp(log_unit)
};

struct AdamSettings {
    float beta1, beta2;
    float epsilon;           // added to the root of the second moment
    float settle_steps;      // learning rates decay as 1 / (1 + steps / settle_steps); 0: no decay
};

void adam_step(const int64_t* ids, int64_t count, int32_t* steps, const AdamGroup* groups, int group_count,
               const AdamSettings& settings);

}  // namespace semsplat
