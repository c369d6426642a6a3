// Fused hash grid query on the CPU, forward and backward (see hash_grid.py for the formulas and the table's layout).
//
// Intervals are handled in chunks, a chunk level by level, so that one level's table stays in the cache, and a level in
// blocks of B intervals times S samples, sample-major: cell, corner rows, trilinear shares and the erf weight of a whole
// block are computed in loops that vectorise, samples in one cell become one, and the rows are gathered or scattered.
// Backward recomputes the corners and lets one thread own a level: no atomics, and the same sum order on every run.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <omp.h>

namespace {

constexpr int B = 16;       // intervals per block
constexpr int MAX_S = 6;    // samples per interval
constexpr int P = B * MAX_S;
constexpr int CHUNK = 1024;  // blocks per chunk

typedef float Reals __attribute__((vector_size(4 * B)));  // a number of each of a block's intervals
typedef int32_t Integers __attribute__((vector_size(4 * B)));

struct Level {
    int64_t start;
    int32_t resolution;
    uint32_t rows;
    bool hashed;
};

struct Block {
    alignas(64) float x[P], y[P], z[P];
    alignas(64) float sharpness[P];  // 1 / (sqrt 8 std): the erf weight of a level of resolution n is erf(sharpness / n)
    float least;                     // the smallest sharpness; 0 where one is NaN
};

struct Corners {
    alignas(64) float weight[P];
    alignas(64) float share[8][P];   // trilinear weight times level weight / S; 0 for corners outside a dense level
    alignas(64) uint32_t place[8][P];  // of the corner's first feature in the level's table
    alignas(64) int32_t cell[3][P];  // of the corner with share 0 and place 0
    alignas(64) int32_t kept[B];     // of each interval, the samples that are left after `merge`: a bit each
};

// F features of a row; rows lie wherever torch put them.
template <int F>
struct Features {
    typedef float type __attribute__((vector_size(4 * F), aligned(4)));
};
template <>
struct Features<1> {
    typedef float type;
};

// erf(x) for x >= 0, absolute error below 3e-7: the rational approximation of Eigen and XLA.
constexpr float SATURATED = 4.f;  // erf is 1 in float32 from here on
inline float erf_positive(float x) {
    x = x < SATURATED ? x : SATURATED;
    const float q = x * x;
    float a = -2.72614225801306e-10f;
    a = a * q + 2.77068142495902e-08f;
    a = a * q - 2.10102402082508e-06f;
    a = a * q - 5.69250639462346e-05f;
    a = a * q - 7.34990630326855e-04f;
    a = a * q - 2.95459980854025e-03f;
    a = a * q - 1.60960333262415e-02f;
    float b = -1.45660718464996e-05f;
    b = b * q - 2.13374055278905e-04f;
    b = b * q - 1.68282697438203e-03f;
    b = b * q - 7.37332916720468e-03f;
    b = b * q - 1.42647390514189e-02f;
    return x * a / b;
}

void load(Block& b, const float* positions, const float* std, int64_t first, int count, int samples) {
    for (int i = 0; i < B; ++i) {
        // The last block repeats its final interval; what is computed for the repeats is never stored.
        const int64_t source = (first + std::min(i, count - 1)) * samples;
        for (int s = 0; s < samples; ++s) {
            b.x[s * B + i] = positions[3 * (source + s)];
            b.y[s * B + i] = positions[3 * (source + s) + 1];
            b.z[s * B + i] = positions[3 * (source + s) + 2];
            b.sharpness[s * B + i] = std[source + s];
        }
    }
    Reals least = Reals{} + INFINITY;
    Integers nan = {};  // comparisons pass over NaN
    for (int p = 0; p < samples * B; p += B) {
        Reals sharpness = *(Reals*)(b.sharpness + p) * 2.8284271247f;
        sharpness = 1.f / (sharpness < 1e-18f ? Reals{} + 1e-18f : sharpness);
        *(Reals*)(b.sharpness + p) = sharpness;
        least = sharpness < least ? sharpness : least;
        nan |= sharpness != sharpness;
    }
    b.least = INFINITY;
    for (int i = 0; i < B; ++i) b.least = std::min(b.least, nan[i] ? 0.f : least[i]);
}

template <int F>
void corners(Corners& c, const Block& b, const Level& level, int samples) {
    const int points = samples * B;
    const float n = float(level.resolution), inverse_samples = 1.f / samples, inverse_n = 1.f / n;
    const int32_t size = level.resolution;
    const uint32_t mask = level.rows - 1;
    if (b.least * inverse_n >= SATURATED)
        std::fill_n(c.weight, points, inverse_samples);
    else
#pragma omp simd
        for (int p = 0; p < points; ++p) c.weight[p] = erf_positive(b.sharpness[p] * inverse_n) * inverse_samples;
    if (level.hashed) {
#pragma omp simd
        for (int p = 0; p < points; ++p) {
            const float w = c.weight[p];
            float sx = b.x[p] * n - 0.5f, sy = b.y[p] * n - 0.5f, sz = b.z[p] * n - 0.5f;
            float cx = std::floor(sx), cy = std::floor(sy), cz = std::floor(sz);
            float fx = sx - cx, fy = sy - cy, fz = sz - cz;
            c.cell[0][p] = int32_t(cx); c.cell[1][p] = int32_t(cy); c.cell[2][p] = int32_t(cz);
            uint32_t x0 = uint32_t(int32_t(cx)), y0 = uint32_t(int32_t(cy)) * 2654435761u, z0 = uint32_t(int32_t(cz)) * 805459861u;
            uint32_t x1 = x0 + 1u, y1 = y0 + 2654435761u, z1 = z0 + 805459861u;
            float a1 = w * fx, a0 = w - a1, b11 = fy * fz, b10 = fy - b11, b01 = fz - b11, b00 = 1.f - fy - b01;
            c.share[0][p] = a0 * b00; c.place[0][p] = ((x0 ^ y0 ^ z0) & mask) * F;
            c.share[1][p] = a1 * b00; c.place[1][p] = ((x1 ^ y0 ^ z0) & mask) * F;
            c.share[2][p] = a0 * b10; c.place[2][p] = ((x0 ^ y1 ^ z0) & mask) * F;
            c.share[3][p] = a1 * b10; c.place[3][p] = ((x1 ^ y1 ^ z0) & mask) * F;
            c.share[4][p] = a0 * b01; c.place[4][p] = ((x0 ^ y0 ^ z1) & mask) * F;
            c.share[5][p] = a1 * b01; c.place[5][p] = ((x1 ^ y0 ^ z1) & mask) * F;
            c.share[6][p] = a0 * b11; c.place[6][p] = ((x0 ^ y1 ^ z1) & mask) * F;
            c.share[7][p] = a1 * b11; c.place[7][p] = ((x1 ^ y1 ^ z1) & mask) * F;
        }
    } else {
#pragma omp simd
        for (int p = 0; p < points; ++p) {
            const float w = c.weight[p];
            // Far outside points are pulled to the nearest wholly invalid cell, so that the conversion cannot overflow.
            float sx = std::min(std::max(b.x[p] * n - 0.5f, -2.f), n + 1.f);
            float sy = std::min(std::max(b.y[p] * n - 0.5f, -2.f), n + 1.f);
            float sz = std::min(std::max(b.z[p] * n - 0.5f, -2.f), n + 1.f);
            float cx = std::floor(sx), cy = std::floor(sy), cz = std::floor(sz);
            float fx = sx - cx, fy = sy - cy, fz = sz - cz;
            int32_t x0 = int32_t(cx), y0 = int32_t(cy), z0 = int32_t(cz);
            c.cell[0][p] = x0; c.cell[1][p] = y0; c.cell[2][p] = z0;
            float ax0 = (x0 >= 0 && x0 < size) ? w * (1.f - fx) : 0.f, ax1 = (x0 >= -1 && x0 < size - 1) ? w * fx : 0.f;
            float ay0 = (y0 >= 0 && y0 < size) ? 1.f - fy : 0.f, ay1 = (y0 >= -1 && y0 < size - 1) ? fy : 0.f;
            float az0 = (z0 >= 0 && z0 < size) ? 1.f - fz : 0.f, az1 = (z0 >= -1 && z0 < size - 1) ? fz : 0.f;
            uint32_t rx0 = uint32_t(std::min(std::max(x0, 0), size - 1)) * F, rx1 = uint32_t(std::min(std::max(x0 + 1, 0), size - 1)) * F;
            uint32_t ry0 = uint32_t(std::min(std::max(y0, 0), size - 1)) * size * F, ry1 = uint32_t(std::min(std::max(y0 + 1, 0), size - 1)) * size * F;
            uint32_t rz0 = uint32_t(std::min(std::max(z0, 0), size - 1)) * size * size * F, rz1 = uint32_t(std::min(std::max(z0 + 1, 0), size - 1)) * size * size * F;
            float b00 = ay0 * az0, b10 = ay1 * az0, b01 = ay0 * az1, b11 = ay1 * az1;
            c.share[0][p] = ax0 * b00; c.place[0][p] = rx0 + ry0 + rz0;
            c.share[1][p] = ax1 * b00; c.place[1][p] = rx1 + ry0 + rz0;
            c.share[2][p] = ax0 * b10; c.place[2][p] = rx0 + ry1 + rz0;
            c.share[3][p] = ax1 * b10; c.place[3][p] = rx1 + ry1 + rz0;
            c.share[4][p] = ax0 * b01; c.place[4][p] = rx0 + ry0 + rz1;
            c.share[5][p] = ax1 * b01; c.place[5][p] = rx1 + ry0 + rz1;
            c.share[6][p] = ax0 * b11; c.place[6][p] = rx0 + ry1 + rz1;
            c.share[7][p] = ax1 * b11; c.place[7][p] = rx1 + ry1 + rz1;
        }
    }
}

// Samples of an interval that follow each other in one cell have the same eight rows: the first takes the shares of all.
// Most do at coarse levels, and at all levels where intervals are short, around surfaces.
void merge(Corners& c, int samples) {
    Integers same[MAX_S] = {}, some = {};  // in the cell of the sample before: all bits set
    for (int s = 1; s < samples; ++s) {
        same[s] = *(Integers*)(c.cell[0] + s * B) == *(Integers*)(c.cell[0] + s * B - B);
        for (int axis = 1; axis < 3; ++axis) same[s] &= *(Integers*)(c.cell[axis] + s * B) == *(Integers*)(c.cell[axis] + s * B - B);
        some |= same[s];
    }
    Integers kept = {};
    for (int s = 0; s < samples; ++s) kept |= ~same[s] & (1 << s);
    *(Integers*)c.kept = kept;
    int32_t any = 0;
    for (int i = 0; i < B; ++i) any |= some[i];
    if (!any) return;
    for (int k = 0; k < 8; ++k) {
        Reals sum = *(Reals*)(c.share[k] + (samples - 1) * B);
        for (int s = samples - 1; s > 0; --s) {
            sum = *(Reals*)(c.share[k] + (s - 1) * B) + (Reals)((Integers)sum & same[s]);
            *(Reals*)(c.share[k] + (s - 1) * B) = sum;
        }
    }
}

// Ask for the table's rows ahead, where a level is larger than the innermost cache. Corners that differ in x mostly share
// a cache line, so every second one will do.
template <int F, int WRITE>
void prefetch(const float* table, const Corners& c, int samples) {
    if constexpr (F > 1)
        for (int k = 0; k < 8; k += 2)
            for (int p = 0; p < samples * B; ++p) __builtin_prefetch(table + c.place[k][p], WRITE, 3);
}

// Calls use(p) for the places in the block of an interval's samples that are left.
template <typename Use>
inline void each_kept(const Corners& c, int interval, Use use) {
    for (uint32_t left = c.kept[interval]; left; left &= left - 1) use(__builtin_ctz(left) * B + interval);
}

template <int F>
void gather(float* sum, const Corners& c, const float* table) {
    typedef typename Features<F>::type V;
    for (int i = 0; i < B; ++i) {
        V t0 = {}, t1 = {}, t2 = {}, t3 = {};  // four sums: additions need not wait for each other
        each_kept(c, i, [&](int p) {
            auto term = [&](int k) { return c.share[k][p] * *(const V*)(table + c.place[k][p]); };
            t0 += term(0), t1 += term(1), t2 += term(2), t3 += term(3);
            t0 += term(4), t1 += term(5), t2 += term(6), t3 += term(7);
        });
        *(V*)(sum + i * F) = (t0 + t1) + (t2 + t3);
    }
}

template <int F>
void scatter(float* table, const Corners& c, const float* gradient, int64_t stride, int count) {
    typedef typename Features<F>::type V;
    for (int i = 0; i < count; ++i) {
        const V g = *(const V*)(gradient + i * stride);
        each_kept(c, i, [&](int p) {
            for (int k = 0; k < 8; ++k) *(V*)(table + c.place[k][p]) += c.share[k][p] * g;
        });
    }
}

struct Samples {
    const float *positions, *std;
    int64_t intervals;
    int samples;

    int64_t chunks() const { return (intervals + B * CHUNK - 1) / (B * CHUNK); }

    // Calls use(block, first interval, number of intervals) for the blocks of a chunk.
    template <typename Use>
    void each(int64_t chunk, Block* blocks, Use use) const {
        const int64_t begin = chunk * B * CHUNK, end = std::min(intervals, begin + B * CHUNK);
        for (int64_t first = begin; first < end; first += B)
            use(blocks[(first - begin) / B], first, int(std::min<int64_t>(B, end - first)));
    }

    void load_chunk(int64_t chunk, Block* blocks) const {
        each(chunk, blocks, [&](Block& b, int64_t first, int count) { load(b, positions, std, first, count, samples); });
    }
};

template <int F>
void forward(const float* table, const Samples& in, float* out, const Level* levels, int level_count, int threads) {
#pragma omp parallel num_threads(threads)
    {
        std::unique_ptr<Block[]> blocks(new Block[CHUNK]);
        Corners c;
#pragma omp for schedule(static)
        for (int64_t chunk = 0; chunk < in.chunks(); ++chunk) {
            in.load_chunk(chunk, blocks.get());
            for (int l = 0; l < level_count; ++l)
                in.each(chunk, blocks.get(), [&](const Block& b, int64_t first, int count) {
                    alignas(64) float sum[B * F], weight[B] = {};
                    const float* rows = table + levels[l].start * F;
                    corners<F>(c, b, levels[l], in.samples);
                    merge(c, in.samples);
                    prefetch<F, 0>(rows, c, in.samples);
                    gather<F>(sum, c, rows);
                    for (int s = 0; s < in.samples; ++s)
                        for (int i = 0; i < B; ++i) weight[i] += c.weight[s * B + i];
                    for (int i = 0; i < count; ++i) {
                        float* to = out + ((first + i) * level_count + l) * (F + 1);
                        std::memcpy(to, sum + i * F, F * sizeof(float));
                        to[F] = weight[i];
                    }
                });
        }
    }
}

template <int F>
void backward(const float* gradient, const Samples& in, float* table_gradient, const Level* levels, int level_count,
              int threads) {
#pragma omp parallel num_threads(threads)
    {
        std::unique_ptr<Block[]> blocks(new Block[CHUNK]);
        Corners c;
        const int mine = omp_get_thread_num(), team = omp_get_num_threads();
        // Fine levels miss the cache and take longest: dealt out from the finest, back and forth.
        auto owner = [&](int l) {
            const int order = level_count - 1 - l, turn = order % team;
            return order / team % 2 ? team - 1 - turn : turn;
        };
        for (int64_t chunk = 0; chunk < in.chunks(); ++chunk) {
            in.load_chunk(chunk, blocks.get());
            for (int l = 0; l < level_count; ++l) {
                if (owner(l) != mine) continue;
                float* rows = table_gradient + levels[l].start * F;
                in.each(chunk, blocks.get(), [&](const Block& b, int64_t first, int count) {
                    const float* source = gradient + (first * level_count + l) * (F + 1);
                    const int64_t stride = int64_t(level_count) * (F + 1);
                    bool any = false;
                    for (int i = 0; i < count; ++i)
                        for (int f = 0; f < F; ++f) any |= source[i * stride + f] != 0.f;
                    if (!any) return;
                    corners<F>(c, b, levels[l], in.samples);
                    merge(c, in.samples);
                    prefetch<F, 1>(rows, c, in.samples);
                    scatter<F>(rows, c, source, stride, count);
                });
            }
        }
    }
}

}  // namespace

// Forward: in is the table, out (intervals, levels, features + 1) with each level's weight last. Backward: in is the
// gradient of that, out the table's. levels: rows of (start, resolution, rows, hashed) as int64. Returns 0, or 1 where this build has no such F or S.
extern "C" int hash_grid(int is_backward, const float* in, const float* positions, const float* std, float* out,
                         const int64_t* levels, int level_count, int features, int64_t intervals, int samples, int threads) {
    if (level_count > 32 || samples < 1 || samples > MAX_S) return 1;
    const Samples query{positions, std, intervals, samples};
    Level table[32];
    for (int l = 0; l < level_count; ++l)
        table[l] = {levels[4 * l], int32_t(levels[4 * l + 1]), uint32_t(levels[4 * l + 2]), levels[4 * l + 3] != 0};
#define CASE(F)                                                                                                            \
    case F:                                                                                                                \
        if (is_backward) backward<F>(in, query, out, table, level_count, threads);                                         \
        else forward<F>(in, query, out, table, level_count, threads);                                             \
        return 0;
    switch (features) {
        CASE(1) CASE(2) CASE(4) CASE(8)
    }
    return 1;
}
