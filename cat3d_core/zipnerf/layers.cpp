// A chain of narrow layers on many rows, forward and backward (see layers.py for the formulas).
//
// A chunk of rows goes through all layers while it is in the innermost cache; what is between them is never written to
// memory, and the backward pass computes it again. A tile of a product stays in registers.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <omp.h>
#include <type_traits>
#include <vector>

namespace {

constexpr int W = 16;       // numbers in a vector
constexpr int WIDEST = 64;  // inputs or outputs of a layer
constexpr int CHUNK = 64;   // rows that go through the chain together
constexpr int MOST = 4;     // layers
constexpr int MOST_VECTORS = WIDEST / W;

typedef float V __attribute__((vector_size(4 * W)));
typedef float U __attribute__((vector_size(4 * W), aligned(4)));  // wherever it lies

int vectors(int width) { return (width + W - 1) / W; }

// Rows of `width` numbers -> rows of whole vectors, whose ends nobody reads: there stands what follows the row in memory.
// The last rows are copied to the number, as there nothing may follow.
void load(V* to, const float* from, int rows, int width) {
    const int count = vectors(width);
    for (int r = 0; r < rows; ++r)
        if (r * width + count * W <= rows * width)
            for (int n = 0; n < count; ++n) to[r * count + n] = *(const U*)(from + r * width + n * W);
        else
            std::memcpy(to + r * count, from + r * width, width * sizeof(float));
}

// The way back: a row's end is overwritten by the next row.
void store(float* to, const V* from, int rows, int width) {
    const int count = vectors(width);
    for (int r = 0; r < rows; ++r)
        if (r * width + count * W <= rows * width)
            for (int n = 0; n < count; ++n) *(U*)(to + r * width + n * W) = from[r * count + n];
        else
            std::memcpy(to + r * width, from + r * count, width * sizeof(float));
}

// Ask for rows ahead: they come from memory while the rows before them are worked on.
void fetch(const float* from, int64_t numbers) {
    for (int64_t i = 0; i < numbers; i += W) __builtin_prefetch(from + i, 0, 2);
}

// Calls use(integral constant) with the number of vectors as a constant of the compiler.
template <typename Use>
void with_vectors(int count, Use use) {
    if (count == 1) use(std::integral_constant<int, 1>());
    else if (count == 2) use(std::integral_constant<int, 2>());
    else if (count == 3) use(std::integral_constant<int, 3>());
    else use(std::integral_constant<int, 4>());
}

// out[a] += the sum over k of left[a * next + k * along] * right[k], for A sums of N vectors: a tile stays in registers.
template <int N, int A>
inline void product_tile(V* out, const float* left, int next, int along, int terms, const V* right) {
    V sum[A][N];
    for (int a = 0; a < A; ++a)
        for (int n = 0; n < N; ++n) sum[a][n] = out[a * N + n];
    for (int k = 0; k < terms; ++k)
        for (int a = 0; a < A; ++a)
            for (int n = 0; n < N; ++n) sum[a][n] += left[a * next + k * along] * right[k * N + n];
    for (int a = 0; a < A; ++a)
        for (int n = 0; n < N; ++n) out[a * N + n] = sum[a][n];
}

// The same for any number of sums, `width` numbers wide.
void product(V* out, int count, int width, const V* left, int next, int along, int terms, const V* right) {
    with_vectors(vectors(width), [&](auto constant) {
        constexpr int N = constant, A = N == 1 ? 12 : N == 2 ? 8 : N == 3 ? 8 : 5;
        const float* from = (const float*)left;
        int a = 0;
        for (; a + A <= count; a += A) product_tile<N, A>(out + a * N, from + a * next, next, along, terms, right);
        for (; a < count; ++a) product_tile<N, 1>(out + a * N, from + a * next, next, along, terms, right);
    });
}

// out[r] += in[r] * matrix, for `rows` rows of `inputs` numbers.
void multiply_rows(V* out, int outputs, const V* in, int inputs, const V* matrix, int rows) {
    product(out, rows, outputs, in, vectors(inputs) * W, 1, inputs, matrix);
}

// sum[j] += over the rows r of left[r][j] * right[r].
void outer_rows(V* sum, const V* left, int outputs, const V* right, int inputs, int rows) {
    product(sum, outputs, inputs, left, 1, vectors(outputs) * W, rows, right);
}

inline float total(const V& v) {
    typedef float H __attribute__((vector_size(2 * W)));
    H parts[2];
    std::memcpy(parts, &v, sizeof v);
    const H h = parts[0] + parts[1];
    return ((h[0] + h[4]) + (h[1] + h[5])) + ((h[2] + h[6]) + (h[3] + h[7]));
}

// The product for one or two outputs, by rows of the weights: elsewhere most of an output vector would be idle.
void multiply_few(V* out, int outputs, const V* in, int inputs, const V* weights, int rows) {
    const int count = vectors(inputs), left = inputs % W;
    for (int r = 0; r < rows; ++r)
        for (int j = 0; j < outputs; ++j) {
            V sum{};
            for (int n = 0; n < inputs / W; ++n) sum += in[r * count + n] * weights[j * count + n];
            float value = total(sum);
            for (int i = 0; i < left; ++i) value += in[r * count + count - 1][i] * weights[j * count + count - 1][i];
            out[r][j] += value;
        }
}

struct Layer {
    const float *weight, *added;  // (outputs, inputs); (rows / group, outputs)
    int inputs, outputs, relu;
    int64_t group;  // so many rows that follow each other have one row of `added`
    std::vector<V> forth, back;  // the weights in whole vectors, by inputs and by outputs

    void prepare() {
        const int out = vectors(outputs);
        back.resize(outputs * vectors(inputs));
        load(back.data(), weight, outputs, inputs);
        forth.assign(inputs * out, V{});
        for (int j = 0; j < outputs; ++j)
            for (int i = 0; i < inputs; ++i) forth[i * out + j / W][j % W] = weight[j * inputs + i];
    }

    // Calls use(index of the group, its first row here, the end of its rows here) for the groups in a chunk.
    template <typename Use>
    void each_group(int64_t first, int rows, Use use) const {
        for (int r = 0; r < rows;) {
            const int64_t at = (first + r) / group;
            const int end = int(std::min<int64_t>(rows, (at + 1) * group - first));
            use(at, r, end);
            r = end;
        }
    }

    void apply(V* out, const V* in, int64_t first, int rows) const {
        const int count = vectors(outputs);
        each_group(first, rows, [&](int64_t at, int begin, int end) {
            V start[MOST_VECTORS];
            load(start, added + at * outputs, 1, outputs);
            for (int r = begin; r < end; ++r) std::copy_n(start, count, out + r * count);
        });
        if (outputs <= 2) multiply_few(out, outputs, in, inputs, back.data(), rows);
        else multiply_rows(out, outputs, in, inputs, forth.data(), rows);
        if (relu)
            for (int i = 0; i < rows * count; ++i) out[i] = out[i] < 0.f ? V{} : out[i];  // NaN stays NaN
    }
};

struct Chain {
    Layer layers[MOST];
    int count;
    int64_t rows, piece;  // a thread takes `piece` rows at a time: whole groups, so that it has all rows of a group

    bool single(int l) const { return layers[l].group >= rows; }

    // shape: of each layer inputs, outputs, relu, group. Returns whether this build has it.
    bool read(int layer_count, const int64_t* shape, const float* const* weights, const float* const* added, int64_t row_count) {
        if (layer_count < 1 || layer_count > MOST) return false;
        count = layer_count, rows = row_count, piece = CHUNK;
        for (int l = 0; l < count; ++l) {
            const int64_t* s = shape + 4 * l;
            if (std::min(s[0], s[1]) < 1 || std::max(s[0], s[1]) > WIDEST) return false;
            layers[l] = {weights[l], added[l], int(s[0]), int(s[1]), int(s[2]), s[3], {}, {}};
            layers[l].prepare();
            if (!single(l)) piece = s[3] >= CHUNK ? s[3] : CHUNK / s[3] * s[3];
        }
        return true;
    }
    // Calls use(first row, number of rows) for the chunks of a piece.
    template <typename Use>
    void each(int64_t number, Use use) const {
        const int64_t end = std::min(rows, (number + 1) * piece);
        for (int64_t first = number * piece; first < end; first += CHUNK) use(first, int(std::min<int64_t>(CHUNK, end - first)));
    }

    int64_t pieces() const { return (rows + piece - 1) / piece; }
};

// What the layers of a chunk give: y[0] is the input.
struct Values {
    std::vector<V> y[MOST + 1];

    explicit Values(const Chain& chain) {
        y[0].resize(CHUNK * vectors(chain.layers[0].inputs));
        for (int l = 0; l < chain.count; ++l) y[l + 1].resize(CHUNK * vectors(chain.layers[l].outputs));
    }

    void compute(const Chain& chain, const float* in, int64_t first, int rows) {
        const int inputs = chain.layers[0].inputs;
        load(y[0].data(), in + first * inputs, rows, inputs);
        fetch(in + (first + rows) * inputs, std::min<int64_t>(CHUNK, chain.rows - first - rows) * inputs);
        for (int l = 0; l < chain.count; ++l) chain.layers[l].apply(y[l + 1].data(), y[l].data(), first, rows);
    }
};

}  // namespace

// in (rows, inputs) -> out[l] (rows, outputs of layer l), left out where null.
extern "C" int chain_forward(const float* in, int count, const int64_t* shape, const float* const* weights,
                             const float* const* added, float* const* out, int64_t rows, int threads) {
    Chain chain;
    if (!chain.read(count, shape, weights, added, rows)) return 1;
#pragma omp parallel num_threads(threads)
    {
        Values values(chain);
#pragma omp for schedule(static)
        for (int64_t number = 0; number < chain.pieces(); ++number)
            chain.each(number, [&](int64_t first, int n) {
                values.compute(chain, in, first, n);
                for (int l = 0; l < count; ++l) {
                    const int outputs = chain.layers[l].outputs;
                    if (out[l]) store(out[l] + first * outputs, values.y[l + 1].data(), n, outputs);
                }
            });
    }
    return 0;
}

// gradients[l]: of out[l], null for none -> those of in, weights and added.
extern "C" int chain_backward(const float* in, int count, const int64_t* shape, const float* const* weights,
                              const float* const* added, const float* const* gradients, float* of_in, float* const* of_weights,
                              float* const* of_added, int64_t rows, int threads) {
    Chain chain;
    if (!chain.read(count, shape, weights, added, rows)) return 1;
    struct Sums {
        std::vector<V> weight[MOST], add[MOST];
    };
    std::vector<Sums> sums(threads);  // of each thread, added up in their order: the same bits every time
#pragma omp parallel num_threads(threads)
    {
        Sums& mine = sums[omp_get_thread_num()];
        for (int l = 0; l < count; ++l) {
            mine.weight[l].assign(chain.layers[l].outputs * vectors(chain.layers[l].inputs), V{});
            mine.add[l].assign(vectors(chain.layers[l].outputs), V{});
        }
        Values values(chain), slopes(chain);
        std::vector<V> given(CHUNK * vectors(WIDEST));
#pragma omp for schedule(static)
        for (int64_t number = 0; number < chain.pieces(); ++number)
            chain.each(number, [&](int64_t first, int n) {
                values.compute(chain, in, first, n);
                for (int l = count - 1; l >= 0; --l) {
                    const Layer& layer = chain.layers[l];
                    const int wide = vectors(layer.outputs);
                    V *slope = slopes.y[l + 1].data(), *below = slopes.y[l].data(), *add = mine.add[l].data();
                    const V* y = values.y[l + 1].data();
                    if (l == count - 1) std::fill_n(slope, n * wide, V{});
                    if (gradients[l]) {
                        load(given.data(), gradients[l] + first * layer.outputs, n, layer.outputs);
                        const int64_t next = first + n;
                        fetch(gradients[l] + next * layer.outputs, std::min<int64_t>(CHUNK, rows - next) * layer.outputs);
                        for (int i = 0; i < n * wide; ++i) slope[i] += given[i];
                    }
                    if (layer.relu)
                        for (int i = 0; i < n * wide; ++i) slope[i] = y[i] > 0.f ? slope[i] : V{};
                    layer.each_group(first, n, [&](int64_t at, int begin, int end) {
                        if (!chain.single(l) && first + begin == at * layer.group) std::fill_n(add, wide, V{});
                        for (int r = begin; r < end; ++r)
                            for (int i = 0; i < wide; ++i) add[i] += slope[r * wide + i];
                        if (!chain.single(l) && first + end == (at + 1) * layer.group)
                            store(of_added[l] + at * layer.outputs, add, 1, layer.outputs);
                    });
                    outer_rows(mine.weight[l].data(), slope, layer.outputs, values.y[l].data(), layer.inputs, n);
                    std::fill_n(below, n * vectors(layer.inputs), V{});
                    multiply_rows(below, layer.inputs, slope, layer.outputs, layer.back.data(), n);
                }
                const int inputs = chain.layers[0].inputs;
                store(of_in + first * inputs, slopes.y[0].data(), n, inputs);
            });
    }
    for (int l = 0; l < count; ++l) {
        Sums& total = sums[0];
        for (int t = 1; t < threads; ++t) {
            for (size_t i = 0; i < sums[t].weight[l].size(); ++i) total.weight[l][i] += sums[t].weight[l][i];
            for (size_t i = 0; i < sums[t].add[l].size(); ++i) total.add[l][i] += sums[t].add[l][i];
        }
        store(of_weights[l], total.weight[l].data(), chain.layers[l].outputs, chain.layers[l].inputs);
        if (chain.single(l)) store(of_added[l], total.add[l].data(), 1, chain.layers[l].outputs);
    }
    return 0;
}
