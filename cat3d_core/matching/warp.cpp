// What the photos show at a target's hypotheses, forward and backward, and how it is pooled over the photos (see
// targets.py for the formulas, which are the reference). Everything is float32; rows of an image are handled in blocks of
// P pixels, so that projection and evidence vectorise, and the features of a voxel lie together in memory.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <omp.h>
#include <vector>

namespace {

constexpr int P = 16;         // pixels of a block
constexpr int EVIDENCE = 8;   // numbers a voxel has beside its features
constexpr float FAR = 4.f;    // image coordinates are clamped to this
constexpr float BEHIND = 1e-3f;

// exp(x), relative error below 3e-7 for |x| <= 87; smaller and larger x are clamped.
inline float fast_exp(float x) {
    x = std::min(std::max(x, -87.f), 87.f);
    const float n = std::nearbyint(x * 1.44269504f);
    const float r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    float p = 1.9875691500e-4f;
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * r * r + r + 1.f;
    const int32_t bits = (static_cast<int32_t>(n) + 127) << 23;
    float scale;
    std::memcpy(&scale, &bits, 4);
    return p * scale;
}
// log(x) for normal x > 0, absolute error below 2e-7 times max(1, |log x|) (Cephes' logf).
inline float fast_log(float x) {
    int32_t bits;
    std::memcpy(&bits, &x, 4);
    int32_t exponent = ((bits >> 23) & 0xff) - 126;
    bits = (bits & 0x007fffff) | 0x3f000000;
    float m;
    std::memcpy(&m, &bits, 4);
    const bool low = m < 0.707106781f;
    const float n = static_cast<float>(low ? exponent - 1 : exponent), r = (low ? m + m : m) - 1.f, z = r * r;
    float p = 7.0376836292e-2f;
    p = p * r - 1.1514610310e-1f;
    p = p * r + 1.1676998740e-1f;
    p = p * r - 1.2420140846e-1f;
    p = p * r + 1.4249322787e-1f;
    p = p * r - 1.6668057665e-1f;
    p = p * r + 2.0000714765e-1f;
    p = p * r - 2.4999993993e-1f;
    p = p * r + 3.3333331174e-1f;
    return n * 0.693359375f + (r + (p * r * z - n * 2.12194440e-4f - 0.5f * z));
}
inline float fast_tanh(float x) { return 1.f - 2.f / (fast_exp(2.f * x) + 1.f); }

struct Shape {
    int64_t targets, photos, planes, height, width;  // of the hypotheses
    int64_t channels, map_height, map_width;         // of the photos' features
    int64_t own_height, own_width;                   // of the photos' depth
    float rate, scale;                               // position of an inverse depth d is log1p(d / scale) / rate
};

// A block's places in one photo.
struct Places {
    float x[P], y[P], inverse[P], valid[P];
};

inline void project(const float* turn, const float* shift, const float* d, float y, int64_t first, int64_t width,
                    int count, Places& at) {
    for (int i = 0; i < P; ++i) {
        const float x = (first + i + 0.5f) / width * 2.f - 1.f;
        const float depth = i < count ? d[i] : 0.f;
        const float u = turn[0] * x + turn[1] * y + turn[2] + shift[0] * depth;
        const float v = turn[3] * x + turn[4] * y + turn[5] + shift[1] * depth;
        const float w = turn[6] * x + turn[7] * y + turn[8] + shift[2] * depth;
        const float z = std::max(w, BEHIND);
        const float gx = std::min(std::max(u / z, -FAR), FAR), gy = std::min(std::max(v / z, -FAR), FAR);
        at.x[i] = gx;
        at.y[i] = gy;
        at.inverse[i] = depth / z;
        at.valid[i] = (w > BEHIND && std::fabs(gx) <= 1.f && std::fabs(gy) <= 1.f) ? 1.f : 0.f;
    }
}

struct Corners {
    int64_t row[4];
    float share[4];
};

// Bilinear with the border repeated (grid_sample, align_corners=False).
inline Corners corners(float gx, float gy, int64_t height, int64_t width) {
    const float x = std::min(std::max((gx + 1.f) * 0.5f * width - 0.5f, 0.f), width - 1.f);
    const float y = std::min(std::max((gy + 1.f) * 0.5f * height - 0.5f, 0.f), height - 1.f);
    const int64_t x0 = static_cast<int64_t>(x), y0 = static_cast<int64_t>(y);
    const int64_t x1 = std::min(x0 + 1, width - 1), y1 = std::min(y0 + 1, height - 1);
    const float a = x - x0, b = y - y0;
    return {{y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1},
            {(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b}};
}

inline int64_t nearest(float gx, float gy, int64_t height, int64_t width) {
    const float x = std::min(std::max((gx + 1.f) * 0.5f * width - 0.5f, 0.f), width - 1.f);
    const float y = std::min(std::max((gy + 1.f) * 0.5f * height - 0.5f, 0.f), height - 1.f);
    return static_cast<int64_t>(std::nearbyint(y)) * width + static_cast<int64_t>(std::nearbyint(x));
}

// The numbers of a voxel that depend on the photo's own depth, and their derivatives.
struct Evidence {
    float value[EVIDENCE][P], agreement[P];
    float units[P], behind[P], sharp[P];  // kept for `backward`
};

inline void evidence(const Shape& s, const Places& at, const float* d, int count, float baseline, const float* position,
                     const float* log_spread, Evidence& e) {
    for (int i = 0; i < P; ++i) {
        const float depth = i < count ? d[i] : 0.f;
        const float behind = position[i] - fast_log(1.f + at.inverse[i] / s.scale) / s.rate;
        const float sharp = fast_exp(-log_spread[i]), units = behind * sharp;
        e.behind[i] = behind;
        e.sharp[i] = sharp;
        e.units[i] = units;
        e.value[0][i] = fast_exp(-std::fabs(units));
        e.value[1][i] = fast_tanh(units * 0.5f);
        e.value[2][i] = fast_tanh(behind * 12.f);
        e.value[3][i] = fast_exp(-(behind * 40.f) * (behind * 40.f));
        e.value[4][i] = log_spread[i] / 3.f + 1.f;
        e.value[5][i] = at.valid[i];
        e.value[6][i] = std::min(baseline * depth, 3.f) / 3.f;
        e.value[7][i] = std::min(at.inverse[i] / std::max(depth, 1e-3f), 4.f) / 4.f;
        e.agreement[i] = fast_log(0.05f + 0.95f * fast_exp(-std::fabs(units) * 0.5f));
    }
}

// C: the number of channels, or 0 for any.
template <int C>
inline void read(const float* map, const Corners& c, int64_t any, float* out) {
    const int64_t channels = C ? C : any;
    const float *a = map + c.row[0] * channels, *b = map + c.row[1] * channels;
    const float *g = map + c.row[2] * channels, *h = map + c.row[3] * channels;
    for (int64_t f = 0; f < channels; ++f)
        out[f] = c.share[0] * a[f] + c.share[1] * b[f] + c.share[2] * g[f] + c.share[3] * h[f];
}

template <int C>
inline void add(float* map, const Corners& c, int64_t any, const float* in) {
    const int64_t channels = C ? C : any;
    for (int n = 0; n < 4; ++n) {
        float* out = map + c.row[n] * channels;
        for (int64_t f = 0; f < channels; ++f) out[f] += c.share[n] * in[f];
    }
}

}  // namespace

// features (B, map_height, map_width, channels), own (B, own_height, own_width, 2); photos (N, M); turn (N, M, 9), shift
// (N, M, 3), baseline (N, M); depth (N, K, H, W). Out: voxels (N, M, K, H, W, channels + 8), valid and agreement
// (N, M, K, H, W). Backward (gradient given): adds to features_gradient and own_gradient instead; one thread owns a
// target's photo, and photos of several targets are added one after the other, so that sums keep their order.
extern "C" void gather(const int64_t* sizes, const float* rates, const float* features, const float* own,
                       const int64_t* photos, const float* turn, const float* shift, const float* baseline,
                       const float* depth, float* voxels, float* valid, float* agreement, const float* voxels_gradient,
                       const float* agreement_gradient, float* features_gradient, float* own_gradient, int threads) {
    const Shape s{sizes[0], sizes[1], sizes[2], sizes[3], sizes[4], sizes[5], sizes[6], sizes[7], sizes[8], sizes[9],
                  rates[0], rates[1]};
    const bool backward = voxels_gradient != nullptr;
    const int64_t plane = s.height * s.width, row_length = s.channels + EVIDENCE;
    const int64_t jobs = s.targets * s.photos * (backward ? 1 : s.planes);
#pragma omp parallel for num_threads(backward ? 1 : threads) schedule(dynamic)
    for (int64_t job = 0; job < jobs; ++job) {
        const int64_t pair = backward ? job : job / s.planes, target = pair / s.photos;
        const int64_t k0 = backward ? 0 : job % s.planes, k1 = backward ? s.planes : k0 + 1;
        const int64_t photo = photos[pair];
        const float* map = features + photo * s.map_height * s.map_width * s.channels;
        const float* mine = own + photo * s.own_height * s.own_width * 2;
        Places at;
        Evidence e;
        float position[P], log_spread[P];
        int64_t cell[P];
        for (int64_t k = k0; k < k1; ++k)
            for (int64_t j = 0; j < s.height; ++j) {
                const float y = (j + 0.5f) / s.height * 2.f - 1.f;
                for (int64_t first = 0; first < s.width; first += P) {
                    const int count = static_cast<int>(std::min<int64_t>(P, s.width - first));
                    const float* d = depth + (target * s.planes + k) * plane + j * s.width + first;
                    const int64_t voxel = (pair * s.planes + k) * plane + j * s.width + first;
                    project(turn + pair * 9, shift + pair * 3, d, y, first, s.width, count, at);
                    for (int i = 0; i < P; ++i) {
                        cell[i] = nearest(at.x[i], at.y[i], s.own_height, s.own_width);
                        position[i] = mine[cell[i] * 2];
                        log_spread[i] = mine[cell[i] * 2 + 1];
                    }
                    evidence(s, at, d, count, baseline[pair], position, log_spread, e);
                    for (int i = 0; i < count; ++i) {
                        const Corners c = corners(at.x[i], at.y[i], s.map_height, s.map_width);
                        if (!backward) {
                            float* out = voxels + (voxel + i) * row_length;
                            if (s.channels == 24) read<24>(map, c, 24, out);
                            else if (s.channels == 16) read<16>(map, c, 16, out);
                            else read<0>(map, c, s.channels, out);
                            for (int f = 0; f < EVIDENCE; ++f) out[s.channels + f] = e.value[f][i];
                            valid[voxel + i] = at.valid[i];
                            agreement[voxel + i] = e.agreement[i];
                        } else {
                            const float* in = voxels_gradient + (voxel + i) * row_length;
                            float* map_out = features_gradient + photo * s.map_height * s.map_width * s.channels;
                            if (s.channels == 24) add<24>(map_out, c, 24, in);
                            else if (s.channels == 16) add<16>(map_out, c, 16, in);
                            else add<0>(map_out, c, s.channels, in);
                            const float* g = in + s.channels;
                            const float sign = e.units[i] > 0 ? 1.f : (e.units[i] < 0 ? -1.f : 0.f);
                            const float t1 = e.value[1][i], t2 = e.value[2][i];
                            const float near = fast_exp(-std::fabs(e.units[i]) * 0.5f);
                            // Derivatives by `units` and by `behind` alone.
                            const float by_units = -g[0] * sign * e.value[0][i] + g[1] * 0.5f * (1 - t1 * t1) -
                                                   agreement_gradient[voxel + i] * 0.475f * sign * near /
                                                       (0.05f + 0.95f * near);
                            const float by_behind = g[2] * 12.f * (1 - t2 * t2) - g[3] * 3200.f * e.behind[i] * e.value[3][i];
                            float* out = own_gradient + (photo * s.own_height * s.own_width + cell[i]) * 2;
                            out[0] += by_units * e.sharp[i] + by_behind;
                            out[1] += g[4] / 3.f - by_units * e.units[i];
                        }
                    }
                }
            }
    }
}

// Pooling over the photos: hidden (N, M, V, C + 1), valid (N, M, V); the first number of a vector is its weight's logit,
// the others are cut at 0. Out (N, V, 2 C + 2): weighted mean, weighted variance, sum of weights, share of photos that see
// it. Backward: hidden_gradient (N, M, V, C + 1) from gradient (N, V, 2 C + 2).
extern "C" void pool(const int64_t* sizes, const float* hidden, const float* valid, float* out, const float* gradient,
                     float* hidden_gradient, int threads) {
    const int64_t targets = sizes[0], photos = sizes[1], voxels = sizes[2], channels = sizes[3];
    const int64_t row = channels + 1, out_row = 2 * channels + 2;
#pragma omp parallel for num_threads(threads)
    for (int64_t start = 0; start < targets * voxels; start += 256) {
        std::vector<float> weights(photos), sigmoids(photos), mean(channels), variance(channels), by_mean(channels);
        for (int64_t index = start; index < std::min(start + 256, targets * voxels); ++index) {
            const int64_t target = index / voxels, voxel = index % voxels;
            float total = 0, seen = 0;
            for (int64_t m = 0; m < photos; ++m) {
                const int64_t at = (target * photos + m) * voxels + voxel;
                sigmoids[m] = 1.f / (1.f + fast_exp(-hidden[at * row]));
                weights[m] = valid[at] * (sigmoids[m] + 1e-2f);
                total += weights[m];
                seen += valid[at];
            }
            const float over = 1.f / std::max(total, 1e-2f);
            std::fill(mean.begin(), mean.end(), 0.f);
            std::fill(variance.begin(), variance.end(), 0.f);
            for (int64_t m = 0; m < photos; ++m) {
                const float* x = hidden + ((target * photos + m) * voxels + voxel) * row + 1;
                const float w = weights[m] * over;
                for (int64_t f = 0; f < channels; ++f) mean[f] += w * std::max(x[f], 0.f);
            }
            for (int64_t m = 0; m < photos; ++m) {
                const float* x = hidden + ((target * photos + m) * voxels + voxel) * row + 1;
                const float w = weights[m] * over;
                for (int64_t f = 0; f < channels; ++f) {
                    const float off = std::max(x[f], 0.f) - mean[f];
                    variance[f] += w * off * off;
                }
            }
            if (gradient == nullptr) {
                float* o = out + index * out_row;
                std::copy(mean.begin(), mean.end(), o);
                std::copy(variance.begin(), variance.end(), o + channels);
                o[2 * channels] = total;
                o[2 * channels + 1] = seen / photos;
                continue;
            }
            const float *by = gradient + index * out_row, *by_variance = by + channels;
            // sum of w x = mean wherever the weights add up to more than the clamp; the clamp's case follows from `sum`.
            const float sum = total * over;
            float by_over = 0;  // derivative by 1 / total, where it is not clamped
            for (int64_t f = 0; f < channels; ++f) {
                // d variance / d mean = -2 sum w (x - mean) = -2 mean (1 - sum)
                by_mean[f] = by[f] - 2.f * by_variance[f] * mean[f] * (1.f - sum);
                by_over += by_mean[f] * mean[f] + by_variance[f] * variance[f];
            }
            const bool clamped = total < 1e-2f;
            for (int64_t m = 0; m < photos; ++m) {
                const int64_t at = ((target * photos + m) * voxels + voxel) * row;
                const float* x = hidden + at + 1;
                float* o = hidden_gradient + at + 1;
                const float w = weights[m] * over;
                float by_weight = 0;
                for (int64_t f = 0; f < channels; ++f) {
                    const float value = std::max(x[f], 0.f), off = value - mean[f];
                    by_weight += by_mean[f] * value + by_variance[f] * off * off;
                    o[f] = x[f] > 0 ? w * (by_mean[f] + 2.f * by_variance[f] * off) : 0.f;
                }
                by_weight = by_weight * over - (clamped ? 0.f : by_over * over) + by[2 * channels];
                hidden_gradient[at] = by_weight * valid[at / row] * sigmoids[m] * (1.f - sigmoids[m]);
            }
        }
    }
}
