// Squared error and structural similarity of float32 images, worked in float64 in one pass over memory (see psnr.py and
// ssim.py for the formulas).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <omp.h>
#include <vector>

namespace {

constexpr int W = 8;                // numbers in a vector
constexpr int64_t PIECE = 1 << 14;  // numbers that are added up before the sums are: the same for every number of threads

typedef double V __attribute__((vector_size(8 * W)));
typedef double U __attribute__((vector_size(8 * W), aligned(8)));  // wherever it lies

typedef float S __attribute__((vector_size(4 * W), aligned(4)));

// A plane of two images, with `pad` rows and columns of black around it.
struct Plane {
    const float *x, *y;
    int height, width, pad;

    // Sum and difference of the two images in row `row` of what is padded, less the origins.
    void row(int row, double sum_origin, double difference_origin, double* sum, double* difference) const {
        const int across = width + 2 * pad, inside = row - pad;
        if (pad || inside < 0 || inside >= height) {
            std::fill_n(sum, across, -sum_origin);
            std::fill_n(difference, across, -difference_origin);
        }
        if (inside < 0 || inside >= height) return;
        const float *a = x + int64_t(inside) * width, *b = y + int64_t(inside) * width;
#pragma omp simd
        for (int i = 0; i < width; ++i) {
            sum[pad + i] = double(a[i]) + b[i] - sum_origin;
            difference[pad + i] = double(a[i]) - b[i] - difference_origin;
        }
    }
};

// 1 - 2 D / (S + D + 2 c): exactly 1 where D is 0.
inline V similarity(V of_sum, V of_difference, double constant) {
    return 1. - 2. * of_difference / (of_sum + of_difference + 2. * constant);
}

// The sum of tap[t] * from(t) for all taps, which the compiler knows the number of.
template <int COUNT, typename From>
inline V filtered(const double* tap, From from) {
    V even{}, odd{};  // two sums: additions need not wait for each other
    for (int t = 0; t + 1 < COUNT; t += 2) {
        even += tap[t] * *(const U*)from(t);
        odd += tap[t + 1] * *(const U*)from(t + 1);
    }
    return even + odd + tap[COUNT - 1] * *(const U*)from(COUNT - 1);
}

// COUNT is odd.
template <int COUNT>
double ssim_sum(const Plane& plane, const double* taps, double c1, double c2, const double* weight) {
    const int across = plane.width + 2 * plane.pad, down = plane.height + 2 * plane.pad;
    const int width = across - COUNT + 1, border = plane.pad ? 0 : COUNT / 2;
    const int stride = (across + COUNT + 2 * W) / W * W;  // whole vectors may be read at any place of a row
    const int64_t numbers = int64_t(plane.height) * plane.width;
    double sum_origin = 0., difference_origin = 0., tap[COUNT];
    std::copy_n(taps, COUNT, tap);
#pragma omp simd reduction(+ : sum_origin, difference_origin)
    for (int64_t i = 0; i < numbers; ++i) {
        sum_origin += double(plane.x[i]) + plane.y[i];
        difference_origin += double(plane.x[i]) - plane.y[i];
    }
    sum_origin /= numbers, difference_origin /= numbers;
    // Of the last COUNT rows: sum, difference, and the squares of both; then their means along columns.
    std::vector<double> kept(size_t(4) * COUNT * stride, 0.), column(size_t(4) * stride, 0.), weights(stride, 0.);
    std::fill_n(weights.begin(), width, 1.);
    auto line = [&](int kind, int row) { return kept.data() + (size_t(kind) * COUNT + row % COUNT) * stride; };
    V total{};
    for (int row = 0; row < down; ++row) {
        double *sum = line(0, row), *difference = line(1, row), *sum2 = line(2, row), *difference2 = line(3, row);
        plane.row(row, sum_origin, difference_origin, sum, difference);
        for (int i = 0; i < across; i += W) {
            *(U*)(sum2 + i) = *(U*)(sum + i) * *(U*)(sum + i);
            *(U*)(difference2 + i) = *(U*)(difference + i) * *(U*)(difference + i);
        }
        const int top = row - COUNT + 1;
        if (top < 0) continue;
        for (int kind = 0; kind < 4; ++kind) {
            const double* from[COUNT];
            for (int t = 0; t < COUNT; ++t) from[t] = line(kind, top + t);
            double* to = column.data() + kind * stride;
            for (int i = 0; i < across; i += W) *(U*)(to + i) = filtered<COUNT>(tap, [&](int t) { return from[t] + i; });
        }
        if (weight) std::copy_n(weight + int64_t(top + border) * plane.width + border, width, weights.begin());
        for (int i = 0; i < width; i += W) {
            V of[4];
            for (int kind = 0; kind < 4; ++kind)
                of[kind] = filtered<COUNT>(tap, [&](int t) { return column.data() + kind * stride + i + t; });
            V spread_s = of[2] - of[0] * of[0], spread_d = of[3] - of[1] * of[1];
            spread_s = spread_s < 0. ? V{} : spread_s;
            spread_d = spread_d < 0. ? V{} : spread_d;
            const V mean_s = of[0] + sum_origin, mean_d = of[1] + difference_origin;
            const V value = similarity(mean_s * mean_s, mean_d * mean_d, c1) * similarity(spread_s, spread_d, c2);
            total += *(U*)(weights.data() + i) * value;
        }
    }
    double out = 0.;
    for (int i = 0; i < W; ++i) out += total[i];
    return out;
}

}  // namespace

// x, y (images, numbers) -> out (images): the mean squared difference.
extern "C" void squared_error(const float* x, const float* y, double* out, int64_t images, int64_t numbers, int threads) {
    const int64_t pieces = (numbers + PIECE - 1) / PIECE;
    std::vector<double> sums(images * pieces);
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t number = 0; number < images * pieces; ++number) {
        const int64_t first = number / pieces * numbers, begin = number % pieces * PIECE;
        const float *a = x + first, *b = y + first;
        const int64_t end = std::min(numbers, begin + PIECE);
        V sums_of[4] = {};  // four sums: additions need not wait for each other
        int64_t i = begin;
        for (; i + 4 * W <= end; i += 4 * W)
            for (int part = 0; part < 4; ++part) {
                const int64_t at = i + part * W;
                const V off = __builtin_convertvector(*(const S*)(a + at), V) - __builtin_convertvector(*(const S*)(b + at), V);
                sums_of[part] += off * off;
            }
        const V four = (sums_of[0] + sums_of[1]) + (sums_of[2] + sums_of[3]);
        double sum = 0.;
        for (int lane = 0; lane < W; ++lane) sum += four[lane];
        for (; i < end; ++i) sum += (double(a[i]) - b[i]) * (double(a[i]) - b[i]);
        sums[number] = sum;
    }
    for (int64_t image = 0; image < images; ++image) {
        double sum = 0.;
        for (int64_t piece = 0; piece < pieces; ++piece) sum += sums[image * pieces + piece];
        out[image] = sum / numbers;
    }
}

// x, y (images, channels, height, width), weight (images, height, width) or null -> out (images, channels): the sum of
// the local similarity over the windows, each weighed by the pixel at its centre. pad: pixels of black around the image.
// Returns 1 for windows of another size than 7 or 11 taps.
extern "C" int structural_similarity(const float* x, const float* y, const double* weight, double* out, int64_t images,
                                     int channels, int height, int width, const double* taps, int count, int pad, double c1,
                                     double c2, int threads) {
    if (count != 7 && count != 11) return 1;
    const int64_t size = int64_t(height) * width;
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t number = 0; number < images * channels; ++number) {
        const Plane plane{x + number * size, y + number * size, height, width, pad};
        const double* own = weight ? weight + number / channels * size : nullptr;
        out[number] = count == 7 ? ssim_sum<7>(plane, taps, c1, c2, own) : ssim_sum<11>(plane, taps, c1, c2, own);
    }
    return 0;
}
