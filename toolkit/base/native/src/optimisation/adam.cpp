// Adam for the visible Gaussians of a view only.
//
// The visible Gaussians form long runs of consecutive indices. The rows of a run are contiguous in
// memory, and are therefore updated as one array, whatever the width of the parameter.
#include "optimisation/adam.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/simd.hpp"

namespace semsplat {
namespace {

// Maximum number of rows that are updated together.
enum { ROWS = 256 };

// 1 / (1 - beta^step), tabulated up to the step from which it rounds to 1.
class BiasCorrection {
public:
    float operator()(int32_t step) const { return (size_t)step < values_.size() ? values_[(size_t)step] : 1.0f; }

    void prepare(float beta) {
        if (beta == beta_) return;
        beta_ = beta;
        values_.assign(1, 0.0f);  // steps count from 1
        for (float step = 1; values_.back() != 1.0f; ++step) values_.push_back(1.0f / (1.0f - std::pow(beta, step)));
    }

private:
    float beta_ = 0;
    std::vector<float> values_;
};

// Consecutive Gaussians, and what depends on their numbers of steps.
struct Rows {
    int64_t id, position;  // of the first one, in the map and in the compact gradients
    int count;
    float rate[ROWS], correction2[ROWS];
};

// Values of rows for each of the `width` columns.
class Columns {
public:
    explicit Columns(int width) : values_((size_t)ROWS * width + LANES) {}

    const float* of(const float* rows, int count, int width) {
        if (width == 1) return rows;
        float* to = values_.data();
        for (int i = 0; i < count; ++i, to += width) {
            for (int k = 0; k < width; k += 4) {  // the next row overwrites the excess
                for (int lane = 0; lane < 4; ++lane) to[k + lane] = rows[i];
            }
        }
        return values_.data();
    }

private:
    std::vector<float> values_;
};

struct Scratch {
    Columns rate, correction2, unit;
    explicit Scratch(int width) : rate(width), correction2(width), unit(width) {}
};

// Arrays of one parameter for some rows.
struct Values {
    float *parameter, *first, *second;
    const float *gradient, *rate, *correction2, *unit;
};

template <bool IN_UNIT>
SEMSPLAT_INLINE void update(const Values& at, size_t i, const AdamSettings& settings) {
    // Gradient with respect to the parameter in its unit, so that epsilon has the same scale.
    const Floats gradient = IN_UNIT ? load(at.gradient + i) * load(at.unit + i) : load(at.gradient + i);
    const Floats m = load(at.first + i), v = load(at.second + i);
    const Floats first = fma(all(1 - settings.beta1), gradient - m, m);
    const Floats second = fma(all(1 - settings.beta2), fma(gradient, gradient, all(0.0f) - v), v);
    const Floats scale = square_root(second * load(at.correction2 + i)) + all(settings.epsilon);
    store(at.first + i, first);
    store(at.second + i, second);
    store(at.parameter + i, load(at.parameter + i) - load(at.rate + i) * first / scale);
}

template <bool IN_UNIT>
void update_all(const Values& at, size_t count, const AdamSettings& settings) {
    size_t i = 0;
    for (; i + LANES <= count; i += LANES) update<IN_UNIT>(at, i, settings);
    const size_t rest = count - i;
    if (!rest) return;
    // The vector would continue in rows that must not change.
    float parts[7][LANES] = {};
    const float* const from[] = {at.parameter, at.first, at.second, at.gradient, at.rate, at.correction2, at.unit};
    for (int k = 0; k < (IN_UNIT ? 7 : 6); ++k) std::copy_n(from[k] + i, rest, parts[k]);
    update<IN_UNIT>({parts[0], parts[1], parts[2], parts[3], parts[4], parts[5], parts[6]}, 0, settings);
    std::copy_n(parts[0], rest, at.parameter + i);
    std::copy_n(parts[1], rest, at.first + i);
    std::copy_n(parts[2], rest, at.second + i);
}

// Counts a step of some rows, and derives their rates and corrections from it.
void count_step(int32_t* steps, const BiasCorrection& correction1, const BiasCorrection& correction2,
                float settle_steps, Rows& rows) {
    for (int i = 0; i < rows.count; ++i) {
        const int32_t step = ++steps[i];
        rows.rate[i] = settle_steps > 0 ? 1.0f / (1.0f + step / settle_steps) : 1.0f;
    }
    for (int i = 0; i < rows.count; ++i) {
        rows.rate[i] *= correction1(steps[i]);
        rows.correction2[i] = correction2(steps[i]);
    }
}

void update_group(const AdamGroup& group, const Rows& rows, const AdamSettings& settings, Scratch& scratch) {
    float rate[ROWS], unit[ROWS];
    for (int i = 0; i < rows.count; ++i) rate[i] = group.learning_rate * rows.rate[i];
    if (group.log_unit) {
        for (int i = 0; i < rows.count; ++i) {
            unit[i] = std::exp(group.log_unit[rows.id + i]);
            rate[i] *= unit[i];
        }
    }
    const int width = group.width;
    const size_t from = (size_t)rows.id * width;
    const Values at = {group.parameter + from,
                       group.first + from,
                       group.second + from,
                       group.gradient + (size_t)rows.position * width,
                       scratch.rate.of(rate, rows.count, width),
                       scratch.correction2.of(rows.correction2, rows.count, width),
                       group.log_unit ? scratch.unit.of(unit, rows.count, width) : nullptr};
    const size_t count = (size_t)rows.count * width;
    group.log_unit ? update_all<true>(at, count, settings) : update_all<false>(at, count, settings);
}

}  // namespace

void adam_step(const int64_t* ids, int64_t count, int32_t* steps, const AdamGroup* groups, int group_count,
               const AdamSettings& settings) {
    static thread_local BiasCorrection prepared1, prepared2;
    prepared1.prepare(settings.beta1);
    prepared2.prepare(settings.beta2);
    const BiasCorrection &correction1 = prepared1, &correction2 = prepared2;
    int widest = 1;
    for (int k = 0; k < group_count; ++k) widest = std::max(widest, groups[k].width);
#pragma omp parallel
    {
        Scratch scratch(widest);
        Rows rows;
#pragma omp for schedule(static)
        for (int64_t begin = 0; begin < count; begin += ROWS) {
            const int64_t end = std::min<int64_t>(begin + ROWS, count);
            for (int64_t i = begin; i < end; i += rows.count) {
                rows.id = ids[i];
                rows.position = i;
                rows.count = 1;
                while (i + rows.count < end && ids[i + rows.count] == rows.id + rows.count) ++rows.count;
                count_step(steps + rows.id, correction1, correction2, settings.settle_steps, rows);
                for (int k = 0; k < group_count; ++k) update_group(groups[k], rows, settings, scratch);
            }
        }
    }
}

}  // namespace semsplat
