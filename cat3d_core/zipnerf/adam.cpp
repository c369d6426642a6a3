// One step of Adam with decay (see adam.py) in two passes over memory: are all slopes finite, then everything else.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <omp.h>

namespace {

constexpr int64_t PIECE = 1 << 14;  // numbers that a thread takes at a time

// Calls use(part, first, end) for pieces of all parts, dealt out to the threads.
template <typename Use>
void each_piece(const int64_t* sizes, int parts, int threads, Use use) {
#pragma omp parallel num_threads(threads)
    for (int part = 0; part < parts; ++part)
#pragma omp for schedule(static) nowait
        for (int64_t first = 0; first < sizes[part]; first += PIECE) use(part, first, std::min(sizes[part], first + PIECE));
}

}  // namespace

// parts: rows of (value, slope, mean, square) addresses; sizes and settings (decay, rate, correction of the root): of each.
// Returns 1, and changes nothing, where the square of a slope is not finite.
extern "C" int adam(float* const* parts, const int64_t* sizes, const double* settings, int count, double beta1, double beta2,
                    double eps, int threads) {
    int broken = 0;
    each_piece(sizes, count, threads, [&](int part, int64_t first, int64_t end) {
        const float* slope = parts[4 * part + 1];
        float off = 0.f;  // NaN as soon as one square is not finite
#pragma omp simd reduction(+ : off)
        for (int64_t i = first; i < end; ++i) off += slope[i] * slope[i] * 0.f;
        if (off != 0.f)
#pragma omp atomic write
            broken = 1;
    });
    if (broken) return 1;
    each_piece(sizes, count, threads, [&](int part, int64_t first, int64_t end) {
        float *value = parts[4 * part], *mean = parts[4 * part + 2], *square = parts[4 * part + 3];
        const float* slope = parts[4 * part + 1];
        const float pull = float(settings[3 * part]), rate = float(settings[3 * part + 1]);
        const float root = float(settings[3 * part + 2]), tiny = float(eps);
        const float keep = float(beta1), take = float(1. - beta1), keep2 = float(beta2), take2 = float(1. - beta2);
#pragma omp simd
        for (int64_t i = first; i < end; ++i) {
            const float g = slope[i] + pull * value[i];
            const float m = keep * mean[i] + take * g, v = keep2 * square[i] + take2 * g * g;
            mean[i] = m;
            square[i] = v;
            value[i] -= rate * m / (std::sqrt(v) * root + tiny);
        }
    });
    return 0;
}
