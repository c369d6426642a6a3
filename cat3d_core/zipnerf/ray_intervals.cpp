// What happens along rays between the networks (see stepfun.py, render.py and losses.py for the formulas): drawing
// intervals, weights from densities, and the losses on intervals with their slopes. A ray is short (12 to 64 intervals),
// so in torch most of the time went into starting a thousand small operations.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <omp.h>

namespace {

constexpr int MOST = 128;  // intervals of a ray

struct Exponential {
    float exp, minus_one;  // e^x and e^x - 1, each to 2 units of its last place
};

// For x <= 0, -inf included; NaN stays NaN. x = n ln 2 + r, |r| <= ln 2 / 2, and the Taylor series of e^r - 1.
inline Exponential exponential(float x) {
    const float held = x < -104.f ? -104.f : x;
    const float n = std::nearbyint(held * 1.44269504f);
    const float r = (held - n * 0.693145752f) - n * 1.42860677e-6f;
    float p = 1.98412698e-4f;
    p = p * r + 1.38888889e-3f;
    p = p * r + 8.33333333e-3f;
    p = p * r + 4.16666667e-2f;
    p = p * r + 1.66666667e-1f;
    p = p * r + 0.5f;
    p = p * r * r + r;
    // 2^n in two factors, as below 2^-126 there is no normal number.
    const int32_t half = int32_t(n) / 2, rest = int32_t(n) - half;
    int32_t bits[2] = {(half + 127) << 23, (rest + 127) << 23};
    float scale[2];
    std::memcpy(scale, bits, 8);
    return {(1.f + p) * scale[0] * scale[1], p * scale[0] * scale[1] + (scale[0] * scale[1] - 1.f)};
}

// The last of count + 1 ascending knots that is not above x, at most count - 1; `from` is a place to start at.
inline int locate(const double* knots, int count, double x, int from) {
    while (from + 1 < count && knots[from + 1] <= x) ++from;
    return from;
}

}  // namespace

// t (R, bins + 1), logits (R, bins), u (R, count), or (count) for all rays -> out (R, count + 1): see
// stepfun.sample_intervals.
extern "C" int sample_intervals(const float* t, const float* logits, const float* u, float* out, int64_t rays, int u_stride,
                                int bins, int count, int threads) {
    if (bins > MOST || count > MOST || count < 2) return 1;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t ray = 0; ray < rays; ++ray) {
        const float *edge = t + ray * (bins + 1), *logit = logits + ray * bins;
        float* to = out + ray * (count + 1);
        float share[MOST], most = -INFINITY;
        for (int i = 0; i < bins; ++i) {
            share[i] = edge[i + 1] > edge[i] ? logit[i] : -INFINITY;
            most = share[i] > most || std::isnan(share[i]) ? share[i] : most;
        }
        double knots[MOST + 1], centre[MOST];
#pragma omp simd
        for (int i = 0; i < bins; ++i) share[i] = exponential(share[i] - most).exp;
        double sum = 0.;
        for (int i = 0; i < bins; ++i) {
            knots[i] = sum;
            sum += share[i];
        }
        for (int i = 0; i < bins; ++i) knots[i] /= sum;
        knots[bins] = 1.;
        int at = 0;
        for (int j = 0; j < count; ++j) {
            const double x = u[ray * u_stride + j];
            at = locate(knots, bins, x, at);
            const double width = knots[at + 1] - knots[at];
            const double offset = std::min(1., std::max(0., (x - knots[at]) / std::max(width, 1e-30)));
            centre[j] = edge[at] + offset * (double(edge[at + 1]) - edge[at]);
        }
        for (int j = 1; j < count; ++j) to[j] = float(0.5 * (centre[j] + centre[j - 1]));
        to[0] = float(std::max(0., 2. * centre[0] - 0.5 * (centre[1] + centre[0])));
        to[count] = float(std::min(1., 2. * centre[count - 1] - 0.5 * (centre[count - 1] + centre[count - 2])));
        if (std::isnan(sum)) std::fill_n(to, count + 1, NAN);
    }
    return 0;
}

// density, lengths (R, N) -> weights (R, N) = alpha * transmittance, and the transmittance behind each interval (R, N).
extern "C" int weights_forward(const float* density, const float* lengths, float* weights, float* behind, int64_t rays, int count,
                               int threads) {
    if (count > MOST) return 1;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t ray = 0; ray < rays; ++ray) {
        const int64_t at = ray * count;
        float depth[MOST], before[MOST + 1], alpha[MOST] = {};
        before[0] = 0.f;
        for (int i = 0; i < count; ++i) {
            depth[i] = density[at + i] * lengths[at + i];
            before[i + 1] = before[i] + depth[i];
        }
#pragma omp simd
        for (int i = 0; i < count; ++i) {
            alpha[i] = -exponential(-depth[i]).minus_one;
            behind[at + i] = exponential(-before[i + 1]).exp;
        }
        weights[at] = alpha[0];
        for (int i = 1; i < count; ++i) weights[at + i] = alpha[i] * behind[at + i - 1];
    }
    return 0;
}

// gradient of the weights -> that of the density. An interval takes light from all behind it.
extern "C" int weights_backward(const float* gradient, const float* lengths, const float* weights, const float* behind,
                                float* of_density, int64_t rays, int count, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t ray = 0; ray < rays; ++ray) {
        double later = 0.;
        for (int64_t at = (ray + 1) * count - 1; at >= ray * count; --at) {
            of_density[at] = float((double(gradient[at]) * behind[at] - later) * lengths[at]);
            later += double(gradient[at]) * weights[at];
        }
    }
    return 0;
}

// One proposal (s (R, bins + 1), weights (R, bins)) against the blurred final histogram (t (R, count + 1), w (R, count)):
// the loss of each ray summed over its bins, and its slope for the proposal's weights (see losses.interlevel).
extern "C" int interlevel(const float* s, const float* weights, const float* t, const float* w, double halfwidth, double* loss,
                          float* slope, int64_t rays, int bins, int count, int threads) {
    if (bins > MOST || count > MOST) return 1;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t ray = 0; ray < rays; ++ray) {
        const float *edge = t + ray * (count + 1), *weight = w + ray * count, *query = s + ray * (bins + 1);
        double knots[MOST + 1], cumulative[MOST + 1], area[MOST + 1], mass[MOST + 1];
        cumulative[0] = area[0] = 0., knots[0] = edge[0];
        for (int i = 0; i < count; ++i) {
            knots[i + 1] = edge[i + 1];
            cumulative[i + 1] = cumulative[i] + weight[i];
            area[i + 1] = area[i] + 0.5 * (cumulative[i] + cumulative[i + 1]) * (knots[i + 1] - knots[i]);
        }
        for (int side = 0; side < 2; ++side) {
            int at = 0;
            for (int j = 0; j <= bins; ++j) {
                const double x = double(query[j]) + (side ? halfwidth : -halfwidth);
                at = locate(knots, count, x, at);
                const double width = knots[at + 1] - knots[at];
                const double offset = std::min(1., std::max(0., (x - knots[at]) / std::max(width, 4.9e-32)));
                const double integral = area[at] + offset * width * (cumulative[at] + 0.5 * offset * weight[at]) +
                                        std::max(0., x - knots[count]) * cumulative[count];
                mass[j] = side ? (integral - mass[j]) / (2. * halfwidth) : integral;
            }
        }
        double sum = 0.;
        for (int j = 0; j < bins; ++j) {
            const float target = float(std::max(0., mass[j + 1] - mass[j])), own = weights[ray * bins + j];
            const double missed = std::max(0., double(target) - own), scale = double(own) + 1.1920929e-7;
            sum += missed * missed / scale;
            slope[ray * bins + j] = float(-missed / scale * (2. + missed / scale));
        }
        loss[ray] = sum;
    }
    return 0;
}

// t (R, N + 1), w (R, N) -> the distortion of each ray and its slope for w (see stepfun.distortion).
extern "C" int distortion(const float* t, const float* w, float* value, float* slope, int64_t rays, int count, int threads) {
    if (count > MOST) return 1;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t ray = 0; ray < rays; ++ray) {
        const float *edge = t + ray * (count + 1), *weight = w + ray * count;
        float* to = slope + ray * count;
        double width[MOST], above[MOST + 1], total = 0., before = 0., sum = 0.;
        above[count] = 0.;
        for (int i = count - 1; i >= 0; --i) {
            width[i] = double(edge[i + 1]) - edge[i];
            above[i] = above[i + 1] + weight[i];
        }
        // Of each interval's slope, the part from gaps in front of it, then the part from gaps behind.
        for (int i = 0; i < count; ++i) {
            to[i] = float(2. * sum + 2. / 3. * weight[i] * width[i]);
            total += double(weight[i]) * weight[i] * width[i] / 3.;
            before += weight[i];
            if (i + 1 == count) break;
            const double gap = 0.5 * (width[i] + width[i + 1]);
            sum += gap * before;
            total += 2. * gap * before * above[i + 1];
        }
        sum = 0.;
        for (int i = count - 2; i >= 0; --i) {
            sum += 0.5 * (width[i] + width[i + 1]) * above[i + 1];
            to[i] += float(2. * sum);
        }
        value[ray] = float(total);
    }
    return 0;
}
