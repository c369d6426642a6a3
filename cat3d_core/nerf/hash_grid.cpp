// Fused hash grid query on the CPU, forward and backward (see hash_grid.py for the formulas and the table's layout).
//
// Points are handled in blocks of B intervals times S samples, sample-major, so that the loops over a block vectorise:
// cell, corner rows, trilinear shares and the erf weight of a level are computed for the whole block, then gathered.
// Backward recomputes them and lets one thread own a whole level: no atomics, and the same sum order on every run.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <omp.h>

namespace {

constexpr int B = 16;      // intervals per block
constexpr int MAX_S = 6;   // samples per interval
constexpr int P = B * MAX_S;

struct Level {
    int64_t start;
    int32_t resolution;
    uint32_t rows;
    bool hashed;
};

struct Block {
    alignas(64) float x[P], y[P], z[P], std[P];
};

struct Corners {
    alignas(64) float weight[P];
    alignas(64) float share[8][P];  // trilinear weight times level weight / S; 0 for corners outside a dense level
    alignas(64) int32_t row[8][P];
};

// erf(x) for x >= 0, absolute error below 3e-7: Taylor up to 0.5, Abramowitz and Stegun 7.1.28 above.
inline float erf_positive(float x) {
    float q = x * x;
    float small = x * 1.128379167f *
                  (1.f + q * (-1.f / 3 + q * (0.1f + q * (-1.f / 42 + q * (1.f / 216 + q * (-1.f / 1320 + q / 9360.f))))));
    float c = x < 4.f ? x : 4.f;
    float d = 1.f + c * (0.0705230784f + c * (0.0422820123f + c * (0.0092705272f +
              c * (0.0001520143f + c * (0.0002765672f + c * 0.0000430638f)))));
    d *= d; d *= d; d *= d; d *= d;
    float large = 1.f - 1.f / d;
    return x < 0.5f ? small : large;
}

void load(Block& b, const float* positions, const float* std, int64_t first, int count, int samples) {
    for (int s = 0; s < samples; ++s)
        for (int i = 0; i < B; ++i) {
            // The last block repeats its final interval; what is computed for the repeats is never stored.
            int64_t source = (first + std::min(i, count - 1)) * samples + s;
            int p = s * B + i;
            b.x[p] = positions[3 * source];
            b.y[p] = positions[3 * source + 1];
            b.z[p] = positions[3 * source + 2];
            b.std[p] = std[source];
        }
}

void corners(Corners& c, const Block& b, const Level& level, int samples) {
    const int points = samples * B;
    const float n = float(level.resolution), inverse_samples = 1.f / samples;
    const int32_t size = level.resolution;
    const uint32_t mask = level.rows - 1;
    if (level.hashed) {
#pragma omp simd
        for (int p = 0; p < points; ++p) {
            float w = erf_positive(1.f / std::max(2.8284271247f * b.std[p] * n, 1e-12f)) * inverse_samples;
            float sx = b.x[p] * n - 0.5f, sy = b.y[p] * n - 0.5f, sz = b.z[p] * n - 0.5f;
            float cx = std::floor(sx), cy = std::floor(sy), cz = std::floor(sz);
            float fx = sx - cx, fy = sy - cy, fz = sz - cz;
            uint32_t x0 = uint32_t(int32_t(cx)), y0 = uint32_t(int32_t(cy)) * 2654435761u, z0 = uint32_t(int32_t(cz)) * 805459861u;
            uint32_t x1 = x0 + 1u, y1 = y0 + 2654435761u, z1 = z0 + 805459861u;
            float a0 = w * (1.f - fx), a1 = w * fx, b00 = (1.f - fy) * (1.f - fz), b10 = fy * (1.f - fz), b01 = (1.f - fy) * fz, b11 = fy * fz;
            c.weight[p] = w;
            c.share[0][p] = a0 * b00; c.row[0][p] = int32_t((x0 ^ y0 ^ z0) & mask);
            c.share[1][p] = a1 * b00; c.row[1][p] = int32_t((x1 ^ y0 ^ z0) & mask);
            c.share[2][p] = a0 * b10; c.row[2][p] = int32_t((x0 ^ y1 ^ z0) & mask);
            c.share[3][p] = a1 * b10; c.row[3][p] = int32_t((x1 ^ y1 ^ z0) & mask);
            c.share[4][p] = a0 * b01; c.row[4][p] = int32_t((x0 ^ y0 ^ z1) & mask);
            c.share[5][p] = a1 * b01; c.row[5][p] = int32_t((x1 ^ y0 ^ z1) & mask);
            c.share[6][p] = a0 * b11; c.row[6][p] = int32_t((x0 ^ y1 ^ z1) & mask);
            c.share[7][p] = a1 * b11; c.row[7][p] = int32_t((x1 ^ y1 ^ z1) & mask);
        }
    } else {
#pragma omp simd
        for (int p = 0; p < points; ++p) {
            float w = erf_positive(1.f / std::max(2.8284271247f * b.std[p] * n, 1e-12f)) * inverse_samples;
            // Far outside points are pulled to the nearest wholly invalid cell, so that the conversion cannot overflow.
            float sx = std::min(std::max(b.x[p] * n - 0.5f, -2.f), n + 1.f);
            float sy = std::min(std::max(b.y[p] * n - 0.5f, -2.f), n + 1.f);
            float sz = std::min(std::max(b.z[p] * n - 0.5f, -2.f), n + 1.f);
            float cx = std::floor(sx), cy = std::floor(sy), cz = std::floor(sz);
            float fx = sx - cx, fy = sy - cy, fz = sz - cz;
            int32_t x0 = int32_t(cx), y0 = int32_t(cy), z0 = int32_t(cz);
            float ax0 = (x0 >= 0 && x0 < size) ? w * (1.f - fx) : 0.f, ax1 = (x0 >= -1 && x0 < size - 1) ? w * fx : 0.f;
            float ay0 = (y0 >= 0 && y0 < size) ? 1.f - fy : 0.f, ay1 = (y0 >= -1 && y0 < size - 1) ? fy : 0.f;
            float az0 = (z0 >= 0 && z0 < size) ? 1.f - fz : 0.f, az1 = (z0 >= -1 && z0 < size - 1) ? fz : 0.f;
            int32_t rx0 = std::min(std::max(x0, 0), size - 1), rx1 = std::min(std::max(x0 + 1, 0), size - 1);
            int32_t ry0 = std::min(std::max(y0, 0), size - 1) * size, ry1 = std::min(std::max(y0 + 1, 0), size - 1) * size;
            int32_t rz0 = std::min(std::max(z0, 0), size - 1) * size * size, rz1 = std::min(std::max(z0 + 1, 0), size - 1) * size * size;
            float b00 = ay0 * az0, b10 = ay1 * az0, b01 = ay0 * az1, b11 = ay1 * az1;
            c.weight[p] = w;
            c.share[0][p] = ax0 * b00; c.row[0][p] = rx0 + ry0 + rz0;
            c.share[1][p] = ax1 * b00; c.row[1][p] = rx1 + ry0 + rz0;
            c.share[2][p] = ax0 * b10; c.row[2][p] = rx0 + ry1 + rz0;
            c.share[3][p] = ax1 * b10; c.row[3][p] = rx1 + ry1 + rz0;
            c.share[4][p] = ax0 * b01; c.row[4][p] = rx0 + ry0 + rz1;
            c.share[5][p] = ax1 * b01; c.row[5][p] = rx1 + ry0 + rz1;
            c.share[6][p] = ax0 * b11; c.row[6][p] = rx0 + ry1 + rz1;
            c.share[7][p] = ax1 * b11; c.row[7][p] = rx1 + ry1 + rz1;
        }
    }
}

template <int F>
void gather(float (&sum)[B][F], const Corners& c, const float* table, int samples) {
    if constexpr (F == 1) {
        alignas(64) float total[B] = {};
        for (int s = 0; s < samples; ++s)
            for (int k = 0; k < 8; ++k)
#pragma omp simd
                for (int i = 0; i < B; ++i) total[i] += c.share[k][s * B + i] * table[c.row[k][s * B + i]];
        for (int i = 0; i < B; ++i) sum[i][0] = total[i];
    } else {
        for (int i = 0; i < B; ++i) {
            float total[F] = {};
            for (int s = 0; s < samples; ++s)
                for (int k = 0; k < 8; ++k) {
                    const float share = c.share[k][s * B + i];
                    const float* value = table + int64_t(c.row[k][s * B + i]) * F;
                    for (int f = 0; f < F; ++f) total[f] += share * value[f];
                }
            for (int f = 0; f < F; ++f) sum[i][f] = total[f];
        }
    }
}

template <int F>
void forward(const float* table, const float* positions, const float* std, float* features, float* weights,
             const Level* levels, int level_count, int64_t intervals, int samples, int threads) {
    const int64_t blocks = (intervals + B - 1) / B;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t block = 0; block < blocks; ++block) {
        const int64_t first = block * B;
        const int count = int(std::min<int64_t>(B, intervals - first));
        Block b;
        Corners c;
        load(b, positions, std, first, count, samples);
        for (int l = 0; l < level_count; ++l) {
            corners(c, b, levels[l], samples);
            float sum[B][F];
            gather<F>(sum, c, table + levels[l].start * F, samples);
            for (int i = 0; i < count; ++i) {
                float* out = features + ((first + i) * level_count + l) * F;
                for (int f = 0; f < F; ++f) out[f] = sum[i][f];
                float weight = 0.f;
                for (int s = 0; s < samples; ++s) weight += c.weight[s * B + i];
                weights[(first + i) * level_count + l] = weight;
            }
        }
    }
}

template <int F>
void backward(const float* gradient, const float* positions, const float* std, float* table_gradient,
              const Level* levels, int level_count, int64_t intervals, int samples, int threads) {
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
    for (int order = 0; order < level_count; ++order) {
        const int l = level_count - 1 - order;  // fine levels miss the cache and take longest: first
        float* target = table_gradient + levels[l].start * F;
        for (int64_t first = 0; first < intervals; first += B) {
            const int count = int(std::min<int64_t>(B, intervals - first));
            bool any = false;
            for (int i = 0; i < count; ++i)
                for (int f = 0; f < F; ++f) any |= gradient[((first + i) * level_count + l) * F + f] != 0.f;
            if (!any) continue;
            Block b;
            Corners c;
            load(b, positions, std, first, count, samples);
            corners(c, b, levels[l], samples);
            for (int i = 0; i < count; ++i) {
                float g[F];
                const float* source = gradient + ((first + i) * level_count + l) * F;
                for (int f = 0; f < F; ++f) g[f] = source[f];
                for (int s = 0; s < samples; ++s)
                    for (int k = 0; k < 8; ++k) {
                        const float share = c.share[k][s * B + i];
                        float* out = target + int64_t(c.row[k][s * B + i]) * F;
                        for (int f = 0; f < F; ++f) out[f] += share * g[f];
                    }
            }
        }
    }
}

}  // namespace

// levels: rows of (start, resolution, rows, hashed) as int64. Returns 0, or 1 where this build has no such F or S.
extern "C" int hash_grid(int is_backward, const float* in, const float* positions, const float* std, float* out, float* weights,
                         const int64_t* levels, int level_count, int features, int64_t intervals, int samples, int threads) {
    if (level_count > 32 || samples < 1 || samples > MAX_S) return 1;
    Level table[32];
    for (int l = 0; l < level_count; ++l)
        table[l] = {levels[4 * l], int32_t(levels[4 * l + 1]), uint32_t(levels[4 * l + 2]), levels[4 * l + 3] != 0};
#define CASE(F)                                                                                                            \
    case F:                                                                                                                \
        if (is_backward) backward<F>(in, positions, std, out, table, level_count, intervals, samples, threads);            \
        else forward<F>(in, positions, std, out, weights, table, level_count, intervals, samples, threads);                \
        return 0;
    switch (features) {
        CASE(1) CASE(2) CASE(4) CASE(8)
    }
    return 1;
}
