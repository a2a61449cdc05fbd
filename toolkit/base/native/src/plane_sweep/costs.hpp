// Matching costs of the planes of all pixels.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>

#include "plane_sweep/plane_sweep.hpp"

namespace semsplat {

enum {
    MAX_COST = 255,
    // Cost of planes that no source shows: neither good nor bad.
    UNKNOWN_COST = 128,
    // Planes that are processed together; the number of planes is padded to a multiple of it.
    PLANE_BLOCK = 16,
};

// In the order (row, column, plane). Padding costs MAX_COST.
class CostVolume {
public:
    CostVolume(const Sweep& s)
        : width(s.camera.width), height(s.camera.height), planes(s.planes),
          stride((s.planes + PLANE_BLOCK - 1) / PLANE_BLOCK * PLANE_BLOCK),
          values(new uint8_t[(size_t)width * height * stride]) {}

    uint8_t* at(int x, int y) { return &values[((size_t)y * width + x) * stride]; }
    const uint8_t* at(int x, int y) const { return &values[((size_t)y * width + x) * stride]; }

    const int width, height, planes, stride;

private:
    std::unique_ptr<uint8_t[]> values;  // not initialised: each thread first touches what it writes
};

// Compares the reference image with the sources on each plane. Several threads may call `compute` for
// different tiles.
class Matching {
public:
    Matching(const Sweep& sweep, CostVolume& costs);
    ~Matching();
    int tiles() const;
    void compute(int tile) const;

private:
    struct Images;
    const Sweep& s;
    CostVolume& costs;
    std::unique_ptr<const Images> images;
};

// Adds smoothness to the costs, and chooses the best planes.
class Aggregation {
public:
    Aggregation(const Sweep& sweep, const CostVolume& costs, const SweepResult& result);
    // Number of groups of rows and of columns that may be processed at the same time.
    int row_groups() const;
    int column_groups() const;
    void along_rows(int group);
    // Requires that all rows have been processed.
    void along_columns_and_choose(int group);

private:
    const Sweep& s;
    const CostVolume& costs;
    const SweepResult& result;
    uint16_t p1;
    std::unique_ptr<uint16_t[]> totals;  // sums over the paths, in the order of the costs

    uint16_t* total(int x, int y) const;
    uint16_t jump(int x, int y, int last_x, int last_y) const;
    void choose(int x, int y) const;
};

}  // namespace semsplat
