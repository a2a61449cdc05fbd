// Plane sweep with semi-global matching. Every pixel's result is computed in the same order whatever the
// number of threads.
#include "plane_sweep/plane_sweep.hpp"

#include "plane_sweep/costs.hpp"

namespace semsplat {

void sweep(const Sweep& s, const SweepResult& result) {
    CostVolume costs(s);
    const Matching matching(s, costs);
    Aggregation aggregation(s, costs, result);
#pragma omp parallel
    {
#pragma omp for schedule(dynamic)
        for (int tile = 0; tile < matching.tiles(); ++tile) matching.compute(tile);
#pragma omp for schedule(dynamic)
        for (int group = 0; group < aggregation.row_groups(); ++group) aggregation.along_rows(group);
#pragma omp for schedule(dynamic)
        for (int group = 0; group < aggregation.column_groups(); ++group) aggregation.along_columns_and_choose(group);
    }
}

}  // namespace semsplat
