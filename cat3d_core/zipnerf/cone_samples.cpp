// Cone multisampling, contraction and the way into the grid's unit cube in one pass (see frustums.py for the formulas).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <omp.h>

namespace {

constexpr int B = 16;     // intervals per block: the loops over a block vectorise
constexpr int MAX_S = 6;  // samples per interval
constexpr float TINY = 1.17549435e-38f;

// v^(2/3) for v >= 1, relative error below 1e-6: cube root from the exponent's bits and two steps of Halley's method.
inline float two_thirds_power(float v) {
    int32_t bits;
    std::memcpy(&bits, &v, 4);
    bits = bits / 3 + 709921077;
    float y;
    std::memcpy(&y, &bits, 4);
    for (int step = 0; step < 2; ++step) {
        const float cube = y * y * y;
        y = y * (cube + 2.f * v) / (2.f * cube + v);
    }
    return y * y;
}

// rays.perpendicular_basis: two unit vectors orthogonal to d and to each other.
inline void perpendicular(const float* d, float* u, float* v) {
    const float size = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    const float x = d[0] / size, y = d[1] / size, z = d[2] / size, sign = z < 0.f ? -1.f : 1.f;
    const float a = -1.f / (sign + z), b = x * y * a;
    u[0] = 1.f + sign * x * x * a, u[1] = sign * b, u[2] = -sign * x;
    v[0] = b, v[1] = sign + y * y * a, v[2] = -y;
}

}  // namespace

// origins, directions (R, 3), radii (R), t (R, N+1), flip, cosine, sine (R, N), spread, turn_cosine, turn_sine (S) ->
// positions (R, N, S, 3) in the unit cube, std (R, N, S) in its units. Returns 1 for too many samples.
extern "C" int cone_samples(const float* origins, const float* directions, const float* radii, const float* t,
                            const float* flip, const float* cosine, const float* sine, const float* spread,
                            const float* turn_cosine, const float* turn_sine, float* positions, float* std, int64_t rays,
                            int intervals, int samples, int threads) {
    if (samples < 1 || samples > MAX_S) return 1;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t ray = 0; ray < rays; ++ray) {
        const float *o = origins + 3 * ray, *d = directions + 3 * ray;
        float u[3], v[3];
        perpendicular(d, u, v);
        const float width = radii[ray] * 0.70710678f;
        for (int begin = 0; begin < intervals; begin += B) {
            const int count = std::min(B, intervals - begin);
            const int64_t at = ray * intervals + begin;
            const float* edge = t + ray * (intervals + 1) + begin;
            alignas(64) float x[MAX_S][B], y[MAX_S][B], z[MAX_S][B], size[MAX_S][B];
            for (int s = 0; s < samples; ++s) {
                const float along_spread = spread[s], flipped_spread = spread[samples - 1 - s];
                const float tc = turn_cosine[s], ts = turn_sine[s];
#pragma omp simd
                for (int i = 0; i < count; ++i) {
                    const float centre = 0.5f * (edge[i + 1] + edge[i]), half = 0.5f * (edge[i + 1] - edge[i]);
                    const float q = half / std::max(centre, TINY), q2 = q * q;
                    const float step = flip[at + i] > 0.5f ? flipped_spread : along_spread;
                    const float shape = (1.f + q) * (1.f + q) + 2.f + step * std::sqrt((q2 - 1.f) * (q2 - 1.f) + 4.f);
                    const float along = edge[i] + centre * (q / (q2 + 3.f)) * shape;
                    const float radius = width * along;
                    const float c = radius * (cosine[at + i] * tc - sine[at + i] * ts);
                    const float e = radius * (sine[at + i] * tc + cosine[at + i] * ts);
                    const float px = o[0] + d[0] * along + u[0] * c + v[0] * e;
                    const float py = o[1] + d[1] * along + u[1] * c + v[1] * e;
                    const float pz = o[2] + d[2] * along + u[2] * c + v[2] * e;
                    const float squared = px * px + py * py + pz * pz;
                    const float m = squared < 1.f ? 1.f : squared;  // NaN stays NaN
                    const float ladder = 2.f * std::sqrt(m) - 1.f, shrink = 0.25f * ladder / m;
                    x[s][i] = px * shrink + 0.5f;
                    y[s][i] = py * shrink + 0.5f;
                    z[s][i] = pz * shrink + 0.5f;
                    size[s][i] = 0.125f * radius * two_thirds_power(ladder) / m;
                }
            }
            for (int i = 0; i < count; ++i)
                for (int s = 0; s < samples; ++s) {
                    const int64_t out = (at + i) * samples + s;
                    positions[3 * out] = x[s][i];
                    positions[3 * out + 1] = y[s][i];
                    positions[3 * out + 2] = z[s][i];
                    std[out] = size[s][i];
                }
        }
    }
    return 0;
}
