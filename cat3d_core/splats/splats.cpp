// Gaussians onto pixels on the CPU, forward and backward (reference.py has the formulas and the constants).
//
// project: every Gaussian's image, the rectangle of tiles that it reaches, and the order by depth (radix sort).
// forward: lists the Gaussians of each tile in that order and goes along each list, a row of 8 pixels at a time.
// backward: goes along the lists from behind; what a Gaussian gets from one tile is stored by itself and summed in a fixed
// order, so that no atomics are needed and the sums are the same on every run and with any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <omp.h>
#include <vector>

namespace {

constexpr int TILE = 8;  // pixels on a side; a row of a tile is one vector

template <typename R> struct Types;
template <> struct Types<float> { typedef uint32_t Bits; typedef int32_t Int; typedef int32_t Mask __attribute__((vector_size(4 * TILE))); typedef float Row __attribute__((vector_size(4 * TILE))); };
template <> struct Types<double> { typedef uint64_t Bits; typedef int64_t Int; typedef int64_t Mask __attribute__((vector_size(8 * TILE))); typedef double Row __attribute__((vector_size(8 * TILE))); };
template <typename R> using Row = typename Types<R>::Row;
template <typename R> using Int = typename Types<R>::Int;
template <typename R> using Mask = typename Types<R>::Mask;

template <typename R>
struct Camera {
    R rotation[3][3], translation[3];  // camera from world
    R fx, skew, cx, fy, cy;
    R steepest;                        // greatest x/z and y/z at which the projection is linearised
    R near, blur, least_ratio;         // least_ratio < 0: opacities stay as they are
    R least_alpha, most_alpha, least_light;
};

struct Size { int32_t x0, y0, width, height; int columns() const { return (width + TILE - 1) / TILE; } int rows() const { return (height + TILE - 1) / TILE; } };

// A projected Gaussian; its numbers lie in this order in the tensor that the caller keeps.
template <typename R>
struct Image { R u, v, a, b, c, opacity, depth, top, bottom; };  // top, bottom: rows of the window that it can reach
constexpr int IMAGE = 9;

struct Rectangle { int32_t left, top, right, bottom; };  // tiles, right and bottom excluded

template <typename R>
struct Steps {  // of a projection, as the backward pass needs them again
    R x, y, z, slope_x, slope_y, jacobian[2][3], turned[2][3], rotation[3][3], axes[2][3], factor[2][3];
    R xx, xy, yy, minor[3], sharp, determinant, norm;
};

template <typename R>
void rotation_of(R m[3][3], const R* q, R& norm) {
    norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const R w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
    m[0][0] = 1 - 2 * (y * y + z * z); m[0][1] = 2 * (x * y - w * z); m[0][2] = 2 * (x * z + w * y);
    m[1][0] = 2 * (x * y + w * z); m[1][1] = 1 - 2 * (x * x + z * z); m[1][2] = 2 * (y * z - w * x);
    m[2][0] = 2 * (x * z - w * y); m[2][1] = 2 * (y * z + w * x); m[2][2] = 1 - 2 * (x * x + y * y);
}

template <typename R>
bool steps_of(Steps<R>& s, const R* mean, const R* quaternion, const R* scale, const Camera<R>& k) {
    R view[3];
    for (int i = 0; i < 3; ++i) view[i] = k.rotation[i][0] * mean[0] + k.rotation[i][1] * mean[1] + k.rotation[i][2] * mean[2] + k.translation[i];
    s.x = view[0]; s.y = view[1]; s.z = view[2];
    if (!(s.z > k.near)) return false;
    s.slope_x = std::min(std::max(s.x / s.z, -k.steepest), k.steepest);
    s.slope_y = std::min(std::max(s.y / s.z, -k.steepest), k.steepest);
    const R inverse = 1 / s.z;
    s.jacobian[0][0] = k.fx * inverse; s.jacobian[0][1] = k.skew * inverse; s.jacobian[0][2] = -(k.fx * s.slope_x + k.skew * s.slope_y) * inverse;
    s.jacobian[1][0] = 0; s.jacobian[1][1] = k.fy * inverse; s.jacobian[1][2] = -k.fy * s.slope_y * inverse;
    rotation_of(s.rotation, quaternion, s.norm);
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 3; ++j) s.turned[i][j] = s.jacobian[i][0] * k.rotation[0][j] + s.jacobian[i][1] * k.rotation[1][j] + s.jacobian[i][2] * k.rotation[2][j];
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 3; ++j) {
            s.axes[i][j] = s.turned[i][0] * s.rotation[0][j] + s.turned[i][1] * s.rotation[1][j] + s.turned[i][2] * s.rotation[2][j];
            s.factor[i][j] = s.axes[i][j] * scale[j];
        }
    const R *m = s.factor[0], *n = s.factor[1];
    s.xx = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
    s.yy = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    s.xy = m[0] * n[0] + m[1] * n[1] + m[2] * n[2];
    s.minor[0] = m[0] * n[1] - m[1] * n[0]; s.minor[1] = m[0] * n[2] - m[2] * n[0]; s.minor[2] = m[1] * n[2] - m[2] * n[1];
    s.sharp = s.minor[0] * s.minor[0] + s.minor[1] * s.minor[1] + s.minor[2] * s.minor[2];
    s.determinant = s.sharp + k.blur * (s.xx + s.yy) + k.blur * k.blur;
    return true;
}

// The image and the tiles that it reaches; false where it shows nowhere in the window.
template <typename R>
bool image_of(Image<R>& image, Rectangle& tiles, const R* mean, const R* quaternion, const R* scale, R opacity, const Camera<R>& k, Size size) {
    Steps<R> s;
    if (!steps_of(s, mean, quaternion, scale, k)) return false;
    const R rx = s.x / s.z, ry = s.y / s.z;
    image.u = k.fx * rx + k.skew * ry + k.cx - size.x0;
    image.v = k.fy * ry + k.cy - size.y0;
    image.a = (s.yy + k.blur) / s.determinant; image.b = -s.xy / s.determinant; image.c = (s.xx + k.blur) / s.determinant;
    image.opacity = opacity * (k.least_ratio < 0 ? R(1) : std::sqrt(std::max(s.sharp / s.determinant, k.least_ratio)));
    image.depth = s.z;
    const R reach = 2 * std::log(image.opacity / k.least_alpha);  // squared distance, in standard deviations
    if (!(reach > 0) || !std::isfinite(image.u + image.v + image.a + image.b + image.c)) return false;
    // Half a hundredth of a pixel more than exact, so that rounding cuts off nothing.
    const R half_x = std::sqrt(reach * (s.xx + k.blur)) * R(1.001) + R(0.005), half_y = std::sqrt(reach * (s.yy + k.blur)) * R(1.001) + R(0.005);
    const R left = image.u - half_x - R(0.5), right = image.u + half_x - R(0.5);  // pixel centres are at integer + 0.5
    image.top = std::max(std::ceil(image.v - half_y - R(0.5)), R(0));
    image.bottom = std::min(std::floor(image.v + half_y - R(0.5)), R(size.height - 1));
    if (!(right >= 0 && left <= size.width - 1 && image.bottom >= image.top)) return false;
    tiles.left = int32_t(std::max(left, R(0))) / TILE; tiles.right = int32_t(std::min(right, R(size.width - 1))) / TILE + 1;
    tiles.top = int32_t(image.top) / TILE; tiles.bottom = int32_t(image.bottom) / TILE + 1;
    return true;
}

// Indices of positive numbers in rising order, equal ones by index.
template <typename R>
void sort_by_depth(std::vector<int32_t>& order, const Image<R>* images) {
    typedef typename Types<R>::Bits Bits;
    struct Entry { Bits key; int32_t index; };
    std::vector<Entry> entries(order.size()), other(order.size());
    for (size_t i = 0; i < order.size(); ++i) {
        std::memcpy(&entries[i].key, &images[order[i]].depth, sizeof(Bits));
        entries[i].index = order[i];
    }
    for (int shift = 0; shift < int(8 * sizeof(Bits)); shift += 11) {
        size_t begins[2049] = {};
        for (const Entry& e : entries) ++begins[((e.key >> shift) & 2047) + 1];
        for (int i = 0; i < 2048; ++i) begins[i + 1] += begins[i];
        for (const Entry& e : entries) other[begins[(e.key >> shift) & 2047]++] = e;
        entries.swap(other);
    }
    for (size_t i = 0; i < order.size(); ++i) order[i] = entries[i].index;
}

// exp(x) for -6 < x <= 0 (anything in double precision), relative error 2e-7: 2^n times a polynomial.
inline Row<float> exponential(Row<float> x) {
    x = x < -80.f ? Row<float>{} - 80.f : x;
    const Row<float> t = x * 1.44269504f;
    const Mask<float> n = __builtin_convertvector(t - 0.5f, Mask<float>);  // towards zero: rounds to nearest for t <= 0
    const Row<float> whole = __builtin_convertvector(n, Row<float>);
    const Row<float> r = (x - whole * 0.693359375f) + whole * 2.12194440e-4f;
    Row<float> p = r * 1.9875691500e-4f + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * r * r + r + 1.f;
    return p * (Row<float>)((n + 127) << 23);
}
inline Row<double> exponential(Row<double> x) {
    for (int i = 0; i < TILE; ++i) x[i] = std::exp(x[i]);
    return x;
}

template <typename R>
inline Row<R> select(Mask<R> mask, Row<R> value) { return (Row<R>)((Mask<R>)value & mask); }
template <typename V>
inline bool any(V mask) {
    uint64_t words[sizeof(V) / 8], all = 0;
    std::memcpy(words, &mask, sizeof(V));
    for (uint64_t word : words) all |= word;
    return all != 0;
}
template <typename R>
inline R sum(Row<R> v) { return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7])); }

template <typename R>
inline Row<R> columns() { return Row<R>{R(0.5), R(1.5), R(2.5), R(3.5), R(4.5), R(5.5), R(6.5), R(7.5)}; }

// A Gaussian along a row of pixels: the exponential and the alpha before it is capped.
template <typename R>
inline void alpha_of(const Image<R>& g, Row<R> dx, R dy, Row<R>& alpha) {
    const Row<R> power = (g.a * dx * R(-0.5) - g.b * dy) * dx - R(0.5) * g.c * dy * dy;
    alpha = g.opacity * exponential(power < 0 ? power : Row<R>{});
}

// Lists, tile by tile, the Gaussians that reach it, nearest first; of each Gaussian, where it stands in those lists.
struct Lists {
    const int64_t* begins;    // (tiles + 1)
    const int32_t* gaussian;  // (entries)
};

template <typename R, int C>
void forward_tile(int tile, const Lists& lists, const Image<R>* images, const R* features, const Camera<R>& k, Size size, R* out, R* light_out,
                  int32_t* last_out, R* median_out) {
    const int left = tile % size.columns() * TILE, top = tile / size.columns() * TILE;
    const int wide = std::min(TILE, size.width - left), high = std::min(TILE, size.height - top);
    Row<R> light[TILE], sums[TILE][C + 1] = {}, median[TILE];
    Mask<R> last[TILE] = {}, going[TILE];
    int alive = 0;
    for (int r = 0; r < TILE; ++r) {
        light[r] = Row<R>{} + R(1);
        median[r] = Row<R>{} + R(INFINITY);
        for (int i = 0; i < TILE; ++i) going[r][i] = r < high && i < wide ? -1 : 0;
        alive += r < high;
    }
    for (int64_t e = lists.begins[tile]; e < lists.begins[tile + 1] && alive; ++e) {
        const int32_t index = lists.gaussian[e];
        const Image<R>& g = images[index];
        const R* feature = features + int64_t(index) * C;
        const int first = std::max(0, int(g.top) - top), end = std::min(high, int(g.bottom) - top + 1);
        const Row<R> dx = columns<R>() + (R(left) - g.u);
        for (int r = first; r < end; ++r) {
            if (!any(going[r])) continue;
            Row<R> alpha;
            alpha_of(g, dx, R(top + r) + R(0.5) - g.v, alpha);
            Mask<R> drawn = (alpha >= k.least_alpha) & going[r];
            if (!any(drawn)) continue;
            alpha = alpha < k.most_alpha ? alpha : Row<R>{} + k.most_alpha;
            const Row<R> next = light[r] * (R(1) - alpha);
            const Mask<R> ends = drawn & (next < k.least_light);
            going[r] &= ~ends;
            drawn &= ~ends;
            const Row<R> weight = select<R>(drawn, alpha * light[r]);
            for (int c = 0; c < C; ++c) sums[r][c] += weight * feature[c];
            sums[r][C] += weight * g.depth;
            const Mask<R> middle = drawn & (light[r] > R(0.5)) & (next <= R(0.5));
            median[r] = middle ? Row<R>{} + g.depth : median[r];
            light[r] = drawn ? next : light[r];
            last[r] = drawn ? Mask<R>{} + Int<R>(e - lists.begins[tile] + 1) : last[r];
            if (any(ends) && !any(going[r])) --alive;
        }
    }
    const int64_t area = int64_t(size.width) * size.height;
    for (int r = 0; r < high; ++r) {
        const int64_t at = int64_t(top + r) * size.width + left;
        for (int i = 0; i < wide; ++i) {
            for (int c = 0; c <= C; ++c) out[c * area + at + i] = sums[r][c][i];
            light_out[at + i] = light[r][i];
            last_out[at + i] = int32_t(last[r][i]);
            median_out[at + i] = median[r][i];
        }
    }
}

constexpr int SHAPE = 7;  // gradients of u, v, a, b, c, opacity, depth come before those of the features

template <typename R, int C>
void backward_tile(int tile, const Lists& lists, const Image<R>* images, const R* features, const Camera<R>& k, Size size, const R* light_in,
                   const int32_t* last_in, const R* gradient, const R* light_gradient, R* out) {
    const int left = tile % size.columns() * TILE, top = tile / size.columns() * TILE;
    const int wide = std::min(TILE, size.width - left), high = std::min(TILE, size.height - top);
    const int64_t area = int64_t(size.width) * size.height;
    // behind: what the Gaussians behind the present one and the end of the ray give, times the gradient
    Row<R> light[TILE], behind[TILE] = {}, slope[TILE][C + 1] = {};
    Mask<R> last[TILE] = {};
    int64_t count = 0;
    for (int r = 0; r < high; ++r) {
        const int64_t at = int64_t(top + r) * size.width + left;
        light[r] = Row<R>{} + R(1);
        for (int i = 0; i < wide; ++i) {
            light[r][i] = light_in[at + i];
            last[r][i] = last_in[at + i];
            behind[r][i] = light_gradient[at + i] * light_in[at + i];
            for (int c = 0; c <= C; ++c) slope[r][c][i] = gradient[c * area + at + i];
            count = std::max<int64_t>(count, last_in[at + i]);
        }
    }
    const int64_t begin = lists.begins[tile];
    std::memset(out + (begin + count) * (SHAPE + C), 0, (lists.begins[tile + 1] - begin - count) * (SHAPE + C) * sizeof(R));
    for (int64_t e = count - 1; e >= 0; --e) {
        const int32_t index = lists.gaussian[begin + e];
        const Image<R>& g = images[index];
        const R* feature = features + int64_t(index) * C;
        const int first = std::max(0, int(g.top) - top), end = std::min(high, int(g.bottom) - top + 1);
        const Row<R> dx = columns<R>() + (R(left) - g.u);
        Row<R> total[SHAPE + C] = {};
        for (int r = first; r < end; ++r) {
            const R dy = R(top + r) + R(0.5) - g.v;
            Row<R> alpha;
            alpha_of(g, dx, dy, alpha);
            const Mask<R> drawn = (alpha >= k.least_alpha) & (last[r] > Mask<R>{} + Int<R>(e));
            if (!any(drawn)) continue;
            const Mask<R> capped = alpha >= k.most_alpha;
            alpha = capped ? Row<R>{} + k.most_alpha : alpha;
            const Row<R> through = R(1) - alpha, before = light[r] / through;
            const Row<R> weight = select<R>(drawn, alpha * before);
            Row<R> value = slope[r][C] * g.depth;
            for (int c = 0; c < C; ++c) {
                value += slope[r][c] * feature[c];
                total[SHAPE + c] += weight * slope[r][c];
            }
            total[6] += weight * slope[r][C];
            const Row<R> by_alpha = select<R>(drawn & ~capped, before * value - behind[r] / through);
            behind[r] += weight * value;
            light[r] = drawn ? before : light[r];
            const Row<R> by_power = by_alpha * alpha;
            const Row<R> moved = by_power * dx;
            total[0] += moved * g.a + by_power * (g.b * dy);
            total[1] += moved * g.b + by_power * (g.c * dy);
            total[2] += moved * dx;
            total[3] += moved * dy;
            total[4] += by_power * (dy * dy);
            total[5] += by_power;
        }
        R* mine = out + (begin + e) * (SHAPE + C);
        for (int i = 0; i < SHAPE + C; ++i) mine[i] = sum<R>(total[i]);
        mine[2] *= R(-0.5); mine[3] = -mine[3]; mine[4] *= R(-0.5);
        mine[5] /= g.opacity;
    }
}

// From the gradients of an image to those of the Gaussian (adjoints of `steps_of` and `image_of`, last step first).
template <typename R>
void gaussian_gradient(const R* g, const R* mean, const R* quaternion, const R* scale, R opacity, const Camera<R>& k, R* mean_out, R* quaternion_out,
                       R* scale_out, R* opacity_out) {
    Steps<R> s;
    if (!steps_of(s, mean, quaternion, scale, k)) return;
    const R inverse = 1 / s.determinant;
    R g_sharp = 0, g_determinant = 0, factor = 1;
    if (k.least_ratio >= 0) {
        const R ratio = s.sharp * inverse;
        factor = std::sqrt(std::max(ratio, k.least_ratio));
        if (ratio > k.least_ratio) {
            const R g_ratio = g[5] * opacity * R(0.5) / factor;
            g_sharp = g_ratio * inverse;
            g_determinant = -g_ratio * ratio * inverse;
        }
    }
    *opacity_out = g[5] * factor;
    const R a = (s.yy + k.blur) * inverse, b = -s.xy * inverse, c = (s.xx + k.blur) * inverse;
    g_determinant -= (g[2] * a + g[3] * b + g[4] * c) * inverse;
    g_sharp += g_determinant;
    const R g_xx = g[4] * inverse + k.blur * g_determinant, g_yy = g[2] * inverse + k.blur * g_determinant, g_xy = -g[3] * inverse;
    R g_factor[2][3], g_turned[2][3] = {}, g_rotation[3][3];
    for (int j = 0; j < 3; ++j) {
        g_factor[0][j] = 2 * g_xx * s.factor[0][j] + g_xy * s.factor[1][j];
        g_factor[1][j] = 2 * g_yy * s.factor[1][j] + g_xy * s.factor[0][j];
    }
    constexpr int pairs[3][2] = {{0, 1}, {0, 2}, {1, 2}};
    for (int p = 0; p < 3; ++p) {
        const int i = pairs[p][0], j = pairs[p][1];
        const R h = 2 * s.minor[p] * g_sharp;
        g_factor[0][i] += h * s.factor[1][j]; g_factor[0][j] -= h * s.factor[1][i];
        g_factor[1][j] += h * s.factor[0][i]; g_factor[1][i] -= h * s.factor[0][j];
    }
    for (int j = 0; j < 3; ++j) {
        scale_out[j] = g_factor[0][j] * s.axes[0][j] + g_factor[1][j] * s.axes[1][j];
        g_factor[0][j] *= scale[j]; g_factor[1][j] *= scale[j];  // now of `axes`
    }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            g_rotation[i][j] = s.turned[0][i] * g_factor[0][j] + s.turned[1][i] * g_factor[1][j];
            for (int row = 0; row < 2; ++row) g_turned[row][i] += g_factor[row][j] * s.rotation[i][j];
        }
    R g_jacobian[2][3];
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 3; ++j) g_jacobian[i][j] = g_turned[i][0] * k.rotation[j][0] + g_turned[i][1] * k.rotation[j][1] + g_turned[i][2] * k.rotation[j][2];
    const R z = 1 / s.z, rx = s.x * z, ry = s.y * z;
    R g_z = g[6];
    for (int j = 0; j < 3; ++j) g_z -= (g_jacobian[0][j] * s.jacobian[0][j] + g_jacobian[1][j] * s.jacobian[1][j]) * z;
    R g_rx = g[0] * k.fx, g_ry = g[0] * k.skew + g[1] * k.fy;
    if (std::abs(rx) < k.steepest) g_rx -= g_jacobian[0][2] * k.fx * z;
    if (std::abs(ry) < k.steepest) g_ry -= (g_jacobian[0][2] * k.skew + g_jacobian[1][2] * k.fy) * z;
    g_z -= (g_rx * rx + g_ry * ry) * z;
    for (int j = 0; j < 3; ++j) mean_out[j] = (g_rx * k.rotation[0][j] + g_ry * k.rotation[1][j]) * z + g_z * k.rotation[2][j];
    const R w_ = quaternion[0] / s.norm, x_ = quaternion[1] / s.norm, y_ = quaternion[2] / s.norm, z_ = quaternion[3] / s.norm;
    auto& G = g_rotation;
    const R unit[4] = {
        2 * (x_ * (G[2][1] - G[1][2]) + y_ * (G[0][2] - G[2][0]) + z_ * (G[1][0] - G[0][1])),
        2 * (y_ * (G[0][1] + G[1][0]) + z_ * (G[0][2] + G[2][0]) + w_ * (G[2][1] - G[1][2]) - 2 * x_ * (G[1][1] + G[2][2])),
        2 * (x_ * (G[0][1] + G[1][0]) + z_ * (G[1][2] + G[2][1]) + w_ * (G[0][2] - G[2][0]) - 2 * y_ * (G[0][0] + G[2][2])),
        2 * (x_ * (G[0][2] + G[2][0]) + y_ * (G[1][2] + G[2][1]) + w_ * (G[1][0] - G[0][1]) - 2 * z_ * (G[0][0] + G[1][1])),
    };
    const R along = unit[0] * w_ + unit[1] * x_ + unit[2] * y_ + unit[3] * z_, n[4] = {w_, x_, y_, z_};
    for (int i = 0; i < 4; ++i) quaternion_out[i] = (unit[i] - along * n[i]) / s.norm;
}

template <typename R>
struct Scene { const R *means, *quaternions, *scales, *opacities; int64_t count; };

// counts: how many Gaussians show, and how many entries all lists have together.
template <typename R>
void project(const Scene<R>& in, const Camera<R>& k, Size size, Image<R>* images, Rectangle* tiles, int32_t* order_out, int64_t* counts, int threads) {
    std::vector<char> shown(in.count);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int64_t i = 0; i < in.count; ++i)
        shown[i] = image_of(images[i], tiles[i], in.means + 3 * i, in.quaternions + 4 * i, in.scales + 3 * i, in.opacities[i], k, size);
    std::vector<int32_t> order;
    int64_t entries = 0;
    for (int64_t i = 0; i < in.count; ++i)
        if (shown[i]) {
            order.push_back(int32_t(i));
            entries += int64_t(tiles[i].right - tiles[i].left) * (tiles[i].bottom - tiles[i].top);
        }
    sort_by_depth(order, images);
    std::copy(order.begin(), order.end(), order_out);
    counts[0] = int64_t(order.size());
    counts[1] = entries;
}

// begins (tiles + 1), gaussian (entries), place (entries): where each Gaussian, in the order of depth, stands in the lists.
void make_lists(const int32_t* order, int64_t shown, const Rectangle* tiles, Size size, int64_t* begins, int32_t* gaussian, int64_t* place) {
    const int columns = size.columns(), count = columns * size.rows();
    std::fill_n(begins, count + 1, 0);
    auto each = [&](const Rectangle& t, auto use) {
        for (int y = t.top; y < t.bottom; ++y)
            for (int x = t.left; x < t.right; ++x) use(y * columns + x);
    };
    for (int64_t i = 0; i < shown; ++i) each(tiles[order[i]], [&](int tile) { ++begins[tile + 1]; });
    for (int i = 0; i < count; ++i) begins[i + 1] += begins[i];
    std::vector<int64_t> next(begins, begins + count);
    for (int64_t i = 0; i < shown; ++i)
        each(tiles[order[i]], [&](int tile) {
            gaussian[next[tile]] = order[i];
            *place++ = next[tile]++;
        });
}

template <typename R, int C>
void forward(const Lists& lists, const Image<R>* images, const R* features, const Camera<R>& k, Size size, R* out, R* light, int32_t* last, R* median, int threads) {
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads)
    for (int tile = 0; tile < size.columns() * size.rows(); ++tile) forward_tile<R, C>(tile, lists, images, features, k, size, out, light, last, median);
}

template <typename R, int C>
void backward(const Scene<R>& in, const Lists& lists, const int64_t* place, const int32_t* order, int64_t shown, const Image<R>* images, const Rectangle* tiles,
              const R* features, const Camera<R>& k, Size size, const R* light, const int32_t* last, const R* gradient, const R* light_gradient, R* scratch,
              R* means, R* quaternions, R* scales, R* opacities, R* feature_gradient, int threads) {
#pragma omp parallel for schedule(dynamic, 4) num_threads(threads)
    for (int tile = 0; tile < size.columns() * size.rows(); ++tile)
        backward_tile<R, C>(tile, lists, images, features, k, size, light, last, gradient, light_gradient, scratch);
    std::vector<int64_t> begins(shown + 1, 0);
    for (int64_t i = 0; i < shown; ++i) {
        const Rectangle& t = tiles[order[i]];
        begins[i + 1] = begins[i] + int64_t(t.right - t.left) * (t.bottom - t.top);
    }
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int64_t i = 0; i < shown; ++i) {
        const int64_t g = order[i];
        R total[SHAPE + C] = {};
        for (int64_t e = begins[i]; e < begins[i + 1]; ++e)
            for (int c = 0; c < SHAPE + C; ++c) total[c] += scratch[place[e] * (SHAPE + C) + c];
        for (int c = 0; c < C; ++c) feature_gradient[g * C + c] = total[SHAPE + c];
        gaussian_gradient(total, in.means + 3 * g, in.quaternions + 4 * g, in.scales + 3 * g, in.opacities[g], k, means + 3 * g, quaternions + 4 * g,
                          scales + 3 * g, opacities + g);
    }
}

}  // namespace

// camera: the numbers of Camera<R>, in order. window: x0, y0, width, height. All gradients are zero on entry.
#define EXPORT(NAME, R)                                                                                                                                    \
    extern "C" void NAME##_project(const R* means, const R* quaternions, const R* scales, const R* opacities, int64_t count, const R* camera,              \
                                   const int32_t* window, R* images, int32_t* tiles, int32_t* order, int64_t* counts, int threads) {                       \
        project<R>({means, quaternions, scales, opacities, count}, *(const Camera<R>*)camera, *(const Size*)window, (Image<R>*)images, (Rectangle*)tiles,  \
                   order, counts, threads);                                                                                                                \
    }                                                                                                                                                      \
    extern "C" int NAME##_forward(const R* images, const int32_t* tiles, const int32_t* order, int64_t shown, const R* features, int channels,             \
                                  const R* camera, const int32_t* window, int64_t* begins, int32_t* gaussian, int64_t* place, R* out, R* light,            \
                                  int32_t* last, R* median, int threads) {                                                                                 \
        const Size size = *(const Size*)window;                                                                                                            \
        make_lists(order, shown, (const Rectangle*)tiles, size, begins, gaussian, place);                                                                  \
        switch (channels) { FORWARD(R, 1) FORWARD(R, 3) FORWARD(R, 4) FORWARD(R, 6) }                                                                                    \
        return 1;                                                                                                                                          \
    }                                                                                                                                                      \
    extern "C" int NAME##_backward(const R* means, const R* quaternions, const R* scales, const R* opacities, int64_t count, const R* images,              \
                                   const int32_t* tiles, const int32_t* order, int64_t shown, const R* features, int channels, const R* camera,            \
                                   const int32_t* window, const int64_t* begins, const int32_t* gaussian, const int64_t* place, const R* light,            \
                                   const int32_t* last, const R* gradient, const R* light_gradient, R* scratch, R* g_means, R* g_quaternions,              \
                                   R* g_scales, R* g_opacities, R* g_features, int threads) {                                                              \
        switch (channels) { BACKWARD(R, 1) BACKWARD(R, 3) BACKWARD(R, 4) BACKWARD(R, 6) }                                                                                 \
        return 1;                                                                                                                                          \
    }
#define FORWARD(R, C)                                                                                                                                      \
    case C: forward<R, C>({begins, gaussian}, (const Image<R>*)images, features, *(const Camera<R>*)camera, size, out, light, last, median, threads); return 0;
#define BACKWARD(R, C)                                                                                                                                     \
    case C: backward<R, C>({means, quaternions, scales, opacities, count}, {begins, gaussian}, place, order, shown, (const Image<R>*)images,              \
                           (const Rectangle*)tiles, features, *(const Camera<R>*)camera, *(const Size*)window, light, last, gradient, light_gradient,      \
                           scratch, g_means, g_quaternions, g_scales, g_opacities, g_features, threads); return 0;

EXPORT(splats_single, float)
EXPORT(splats_double, double)
