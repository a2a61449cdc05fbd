// Assigns splats to tiles, front to back: count, fill, radix sort within each tile.
#include <algorithm>
#include <cstring>

#include "rendering/splats.hpp"

namespace semsplat {
namespace {

enum { MAX_CHUNKS = 32, MIN_CHUNK = 2048 };

// Whether the splat's disc contains a pixel centre of the tile.
inline bool disc_touches(const Splat& s, float left, float top) {
    const float dx = std::max({left - s.u, s.u - (left + TILE - 1), 0.0f});
    const float dy = std::max({top - s.v, s.v - (top + TILE - 1), 0.0f});
    return dx * dx + dy * dy <= s.support;
}

// Whether the splat's ellipse intersects the tile; see prepare_ellipsoid.
inline bool ellipse_touches(const Splat& s, float left, float top) {
    const float x0 = left - s.u, x1 = x0 + TILE - 1, y0 = top - s.v, y1 = y0 + TILE - 1;
    const float x = std::clamp(0.0f, x0, x1), y = std::clamp(0.0f, y0, y1);
    const float a = s.shape_a, b = s.shape_b, c = s.shape_c;
    const float down = std::clamp(-a * b / (b * b + c * c) * x, y0, y1);
    const float across = std::clamp(-b / a * y, x0, x1);
    const auto form = [&](float dx, float dy) { return (a * dx + b * dy) * (a * dx + b * dy) + c * c * dy * dy; };
    return std::min(form(x, down), form(across, y)) <= s.support;
}

template <Shape SHAPE>
inline bool touches(const Splat& s, int tx, int ty) {
    const float left = (float)(tx * TILE), top = (float)(ty * TILE);
    return SHAPE == Shape::SPHERE ? disc_touches(s, left, top) : ellipse_touches(s, left, top);
}

template <Shape SHAPE, class Visit>
inline void for_each_tile(const Splat& s, const uint8_t* region, int tiles_x, Visit visit) {
    for (int ty = s.tile_y0; ty <= s.tile_y1; ++ty) {
        for (int tx = s.tile_x0; tx <= s.tile_x1; ++tx) {
            const int tile = ty * tiles_x + tx;
            if ((!region || region[tile]) && touches<SHAPE>(s, tx, ty)) visit(tile);
        }
    }
}

struct SortScratch {
    std::vector<uint64_t> a, b;
    std::vector<int32_t> splat, slot;
};

// Stable least-significant-digit radix sort of the upper 32 bits; bytes that are equal in all keys are
// skipped. Returns the buffer with the sorted keys.
uint64_t* radix_sort(uint64_t* keys, uint64_t* other, int n) {
    uint32_t counts[4][256];
    std::memset(counts, 0, sizeof counts);
    for (int i = 0; i < n; ++i) {
        const uint32_t k = (uint32_t)(keys[i] >> 32);
        for (int digit = 0; digit < 4; ++digit) ++counts[digit][(k >> (8 * digit)) & 255];
    }
    for (int digit = 0; digit < 4; ++digit) {
        uint32_t* count = counts[digit];
        const int shift = 32 + 8 * digit;
        if (count[(keys[0] >> shift) & 255] == (uint32_t)n) continue;
        uint32_t place = 0;
        for (int v = 0; v < 256; ++v) {
            const uint32_t c = count[v];
            count[v] = place;
            place += c;
        }
        for (int i = 0; i < n; ++i) other[count[(keys[i] >> shift) & 255]++] = keys[i];
        std::swap(keys, other);
    }
    return keys;
}

void sort_tile(Rasterisation& state, int tile, SortScratch& scratch) {
    const int begin = state.tile_begin[tile], n = state.tile_begin[tile + 1] - begin;
    if (n < 2) return;
    scratch.a.resize(n);
    scratch.b.resize(n);
    scratch.splat.assign(state.pair_splat.data() + begin, state.pair_splat.data() + begin + n);
    scratch.slot.assign(state.pair_slot.data() + begin, state.pair_slot.data() + begin + n);
    for (int i = 0; i < n; ++i) {
        uint32_t depth_bits;  // the bits of positive floats sort like their values
        std::memcpy(&depth_bits, &state.splats[scratch.splat[i]].z, 4);
        scratch.a[i] = (uint64_t)depth_bits << 32 | (uint32_t)i;
    }
    const uint64_t* sorted = radix_sort(scratch.a.data(), scratch.b.data(), n);
    for (int i = 0; i < n; ++i) {
        const uint32_t from = (uint32_t)sorted[i];
        state.pair_splat[begin + i] = scratch.splat[from];
        state.pair_slot[begin + i] = scratch.slot[from];
    }
}

template <Shape SHAPE>
void bin_splats(const uint8_t* region, Rasterisation& out) {
    const int tiles = out.tiles();
    const int64_t visible = (int64_t)out.splats.size();
    const int64_t chunk = std::max<int64_t>(MIN_CHUNK, (visible + MAX_CHUNKS - 1) / MAX_CHUNKS);
    const int chunks = (int)((visible + chunk - 1) / chunk);
    // cursor[c][t]: first the number of pairs of chunk c on tile t, then their write position.
    std::vector<int32_t> cursor((size_t)chunks * tiles, 0);
    std::vector<int64_t> chunk_slots((size_t)chunks + 1, 0);
#pragma omp parallel for schedule(dynamic, 1)
    for (int c = 0; c < chunks; ++c) {
        int32_t* counts = cursor.data() + (size_t)c * tiles;
        int64_t slots = 0;
        for (int64_t i = c * chunk; i < std::min(visible, (c + 1) * chunk); ++i) {
            Splat& s = out.splats[i];
            s.pairs = 0;
            for_each_tile<SHAPE>(s, region, out.tiles_x, [&](int tile) {
                ++counts[tile];
                ++s.pairs;
            });
            s.slot = s.pairs > 1 ? (int32_t)slots : -1;
            if (s.pairs > 1) slots += s.pairs;
        }
        chunk_slots[c + 1] = slots;
    }
    for (int c = 0; c < chunks; ++c) chunk_slots[c + 1] += chunk_slots[c];
    out.slots = chunk_slots[chunks];
    out.tile_begin.resize((size_t)tiles + 1);
    int32_t place = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        out.tile_begin[tile] = place;
        for (int c = 0; c < chunks; ++c) {
            int32_t& cell = cursor[(size_t)c * tiles + tile];
            const int32_t count = cell;
            cell = place;
            place += count;
        }
    }
    out.tile_begin[tiles] = place;
    out.pair_splat.resize(place);
    out.pair_slot.resize(place);
#pragma omp parallel
    {
        SortScratch scratch;
#pragma omp for schedule(dynamic, 1)
        for (int c = 0; c < chunks; ++c) {
            int32_t* cursors = cursor.data() + (size_t)c * tiles;
            for (int64_t i = c * chunk; i < std::min(visible, (c + 1) * chunk); ++i) {
                Splat& s = out.splats[i];
                if (s.slot >= 0) s.slot += (int32_t)chunk_slots[c];
                int32_t slot = s.slot;
                for_each_tile<SHAPE>(s, region, out.tiles_x, [&](int tile) {
                    const int32_t at = cursors[tile]++;
                    out.pair_splat[at] = (int32_t)i;
                    out.pair_slot[at] = slot < 0 ? -1 : slot++;
                });
            }
        }
#pragma omp for schedule(dynamic, 8)
        for (int tile = 0; tile < tiles; ++tile) sort_tile(out, tile, scratch);
    }
}

}  // namespace

void bin(const uint8_t* region, Rasterisation& out) {
    if (out.shape == Shape::SPHERE) {
        bin_splats<Shape::SPHERE>(region, out);
    } else {
        bin_splats<Shape::ELLIPSOID>(region, out);
    }
}

}  // namespace semsplat
