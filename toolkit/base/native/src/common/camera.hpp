// The camera model of all kernels.
#pragma once

namespace semsplat {

// Pixel centres are at integers.
struct Pinhole {
    float fx, fy, cx, cy;
    int width, height;
};

}  // namespace semsplat
