// Missing pixels inside of surfaces.
#pragma once

namespace semsplat {

// Fills missing pixels of inverse depth [H, W] (1 / m, 0 where missing) between opposite neighbours that differ by
// less than max_difference, as a fraction of their mean, with the mean of such pairs.
void fill_depth_gaps(const float* inverse, int width, int height, float max_difference, float* out);

}  // namespace semsplat
