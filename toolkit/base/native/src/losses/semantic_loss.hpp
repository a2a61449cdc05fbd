// The semantic loss of mapping per level (H-10, H-11) and its derivative.
#pragma once

#include <cstdint>

namespace semsplat {

// A code: heads of consecutive channels, each with a target per class.
struct SemanticHeads {
    int count;
    const int32_t* first;      // [heads] first channel
    const int32_t* width;      // [heads] number of channels
    const float* weight;       // [heads] weight in the loss
    const int32_t* targets;    // [classes, heads] target channel of the head, or its bits
    bool bits;                 // sigmoid per channel instead of a softmax per head
};

// Sum of the loss over pixels with a label and a silhouette above the minimum.
//   features, gradient: [S, H, W], composited sums; they are divided by the silhouette [H, W].
//   labels: [H, W] class ids from 1, 0 is void.
//   silhouette_gradient: [H, W], accumulated; null to exclude the geometry.
double semantic_loss(const float* features, const float* silhouette, const int32_t* labels, int height, int width,
                     const SemanticHeads& heads, float min_silhouette, float* gradient,
                     float* silhouette_gradient);

}  // namespace semsplat
