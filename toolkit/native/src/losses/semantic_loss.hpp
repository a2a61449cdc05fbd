// The per-level semantic loss of mapping (H-10, H-11) with its derivative.
#pragma once

#include <cstdint>

namespace semsplat {

// A code as the kernel sees it: heads of consecutive channels, each with a class's target.
struct SemanticHeads {
    int count;
    const int32_t* first;      // [heads] first channel
    const int32_t* width;      // [heads] channels
    const float* weight;       // [heads]
    const int32_t* targets;    // [classes, heads]: a channel of the head, or its bits
    bool bits;                 // sigmoid per channel instead of a softmax per head
};

// Sum over pixels of the loss where the map is opaque enough and the label is not void.
//   features, gradient: [S, H, W], composited sums; they are divided by the silhouette [H, W].
//   labels: [H, W] class ids from 1, 0 void.
//   silhouette_gradient: [H, W], added to, or null where geometry shall not feel semantics.
double semantic_loss(const float* features, const float* silhouette, const int32_t* labels, int height, int width,
                     const SemanticHeads& heads, float least_silhouette, float* gradient,
                     float* silhouette_gradient);

}  // namespace semsplat
