// What a network does on a GPU beside products of matrices. Rows are contiguous, channels last. One launch a layer and
// direction; every sum has a fixed order, so a run on one card gives the same bytes again.

#include <cuda_bf16.h>
#include <math.h>
#include <stdint.h>

// Sizes of a convolution from (b, h, w, c) to (b, oh, ow, n).
struct Geo {
    int b, h, w, c, n, kh, kw, sh, sw, ph, pw, oh, ow;
};

// ---------------------------------------------------------------------------------------------------------------- gathers

// The input row of a sample under a tap of its output position o, or -1.
static __device__ __forceinline__ int under(const Geo &g, int o, int tap) {
    int y = (o / g.ow) * g.sh + tap / g.kw - g.ph;
    int x = (o % g.ow) * g.sw + tap % g.kw - g.pw;
    return y < 0 || y >= g.h || x < 0 || x >= g.w ? -1 : y * g.w + x;
}

// The output position of a sample that reads its input row i through a tap, or -1.
static __device__ __forceinline__ int over(const Geo &g, int i, int tap) {
    int y = i / g.w + g.ph - tap / g.kw;
    int x = i % g.w + g.pw - tap % g.kw;
    if (y < 0 || x < 0 || y % g.sh || x % g.sw) return -1;
    y /= g.sh;
    x /= g.sw;
    return y >= g.oh || x >= g.ow ? -1 : y * g.ow + x;
}

static __device__ __forceinline__ void put(float *to, float v) { *to = v; }
static __device__ __forceinline__ void put(__nv_bfloat16 *to, float v) { *to = __float2bfloat16(v); }
static __device__ __forceinline__ void put4(float *to, float4 v) { *reinterpret_cast<float4 *>(to) = v; }
static __device__ __forceinline__ void put4(__nv_bfloat16 *to, float4 v) {
    __nv_bfloat162 *pairs = reinterpret_cast<__nv_bfloat162 *>(to);
    pairs[0] = __floats2bfloat162_rn(v.x, v.y);
    pairs[1] = __floats2bfloat162_rn(v.z, v.w);
}

static __device__ __forceinline__ float get(const float *from) { return *from; }
static __device__ __forceinline__ float get(const __nv_bfloat16 *from) { return __bfloat162float(*from); }
static __device__ __forceinline__ float4 get4(const float *from) { return *reinterpret_cast<const float4 *>(from); }
static __device__ __forceinline__ float4 get4(const __nv_bfloat16 *from) {
    const __nv_bfloat162 *pairs = reinterpret_cast<const __nv_bfloat162 *>(from);
    float2 a = __bfloat1622float2(pairs[0]), b = __bfloat1622float2(pairs[1]);
    return make_float4(a.x, a.y, b.x, b.y);
}

// The rows under the taps side by side: (b from, c) to (b to, taps c). A block makes `per` rows.
template <typename T, bool OVER, int V>
static __device__ void gather(const float *x, T *out, Geo g, int c, int to, int from, int rows, int per) {
    int taps = g.kh * g.kw, cv = c / V, width = taps * cv;
    int first = blockIdx.x * per, n = min(per, rows - first) * width;
    for (int e = threadIdx.x; e < n; e += blockDim.x) {
        int r = first + e / width, k = e % width, tap = k / cv, j = (k % cv) * V;
        int p = OVER ? over(g, r % to, tap) : under(g, r % to, tap);
        const float *from_row = x + ((size_t)(r / to) * from + (p < 0 ? 0 : p)) * c + j;
        T *place = out + ((size_t)r * taps + tap) * c + j;
        if (V == 4) {
            put4(place, p < 0 ? make_float4(0, 0, 0, 0) : *reinterpret_cast<const float4 *>(from_row));
        } else {
            put(place, p < 0 ? 0.0f : *from_row);
        }
    }
}

#define GATHER(NAME, T, OVER, V)                                                                                             \
    extern "C" __global__ void NAME(const float *x, T *out, Geo g, int c, int to, int from, int rows, int per) {             \
        gather<T, OVER, V>(x, out, g, c, to, from, rows, per);                                                               \
    }
GATHER(under_f32_1, float, false, 1)
GATHER(under_f32_4, float, false, 4)
GATHER(under_bf16_1, __nv_bfloat16, false, 1)
GATHER(under_bf16_4, __nv_bfloat16, false, 4)
GATHER(over_f32_1, float, true, 1)
GATHER(over_f32_4, float, true, 4)
GATHER(over_bf16_1, __nv_bfloat16, true, 1)
GATHER(over_bf16_4, __nv_bfloat16, true, 4)

// The inverse of a gather with sums: what rows (b to, taps c) hold for each of (b from, c). OVER is that of the gather.
template <typename T, bool OVER, int V>
static __device__ void collect(const T *rows_of, float *dx, Geo g, int c, int to, int from, int rows, int per) {
    int taps = g.kh * g.kw, cv = c / V;
    int first = blockIdx.x * per, n = min(per, rows - first) * cv;
    for (int e = threadIdx.x; e < n; e += blockDim.x) {
        int r = first + e / cv, j = (e % cv) * V;
        const T *sample = rows_of + (size_t)(r / from) * to * taps * c + j;
        float4 sum = make_float4(0, 0, 0, 0);
        for (int tap = 0; tap < taps; ++tap) {
            int p = OVER ? under(g, r % from, tap) : over(g, r % from, tap);
            if (p < 0) continue;
            const T *place = sample + ((size_t)p * taps + tap) * c;
            if (V == 4) {
                float4 v = get4(place);
                sum.x += v.x;
                sum.y += v.y;
                sum.z += v.z;
                sum.w += v.w;
            } else {
                sum.x += get(place);
            }
        }
        float *out = dx + (size_t)r * c + j;
        if (V == 4) {
            *reinterpret_cast<float4 *>(out) = sum;
        } else {
            *out = sum.x;
        }
    }
}

#define COLLECT(NAME, T, OVER, V)                                                                                            \
    extern "C" __global__ void NAME(const T *d, float *dx, Geo g, int c, int to, int from, int rows, int per) {              \
        collect<T, OVER, V>(d, dx, g, c, to, from, rows, per);                                                               \
    }
COLLECT(collect_under_f32_1, float, false, 1)
COLLECT(collect_under_f32_4, float, false, 4)
COLLECT(collect_under_bf16_1, __nv_bfloat16, false, 1)
COLLECT(collect_under_bf16_4, __nv_bfloat16, false, 4)
COLLECT(collect_over_f32_1, float, true, 1)
COLLECT(collect_over_f32_4, float, true, 4)
COLLECT(collect_over_bf16_1, __nv_bfloat16, true, 1)
COLLECT(collect_over_bf16_4, __nv_bfloat16, true, 4)

static __device__ __forceinline__ size_t index() { return (size_t)blockIdx.x * blockDim.x + threadIdx.x; }

// Four numbers a thread.
extern "C" __global__ void to_bf16(const float *x, __nv_bfloat16 *y, size_t n) {
    size_t i = 4 * index();
    if (i + 4 <= n && reinterpret_cast<uintptr_t>(x) % 16 == 0) {
        put4(y + i, get4(x + i));
    } else {
        for (size_t end = i + 4 < n ? i + 4 : n; i < end; ++i) put(y + i, x[i]);
    }
}

extern "C" __global__ void add_bias(float *y, const float *bias, size_t n, int width) {
    size_t i = index();
    if (i < n) y[i] += bias[i % width];
}

// ------------------------------------------------------------------------------------------------- what cuDNN reads and writes

// Four numbers a thread, of rows of `width`; `bias` may be null. n and width are multiples of four.
extern "C" __global__ void from_bf16(const __nv_bfloat16 *x, const float *bias, float *y, size_t n, int width) {
    size_t i = 4 * index();
    if (i >= n) return;
    float4 v = get4(x + i);
    if (bias) {
        const float *b = bias + i % width;
        v = make_float4(v.x + b[0], v.y + b[1], v.z + b[2], v.w + b[3]);
    }
    put4(y + i, v);
}

// Rows of c numbers to rows of `wide`, zeros behind them: n = rows wide.
template <typename T> static __device__ __forceinline__ void pad(const float *x, T *y, size_t n, int c, int wide) {
    size_t i = index();
    if (i >= n) return;
    int j = i % wide;
    put(y + i, j < c ? x[i / wide * c + j] : 0.0f);
}

// The way back: n = rows c.
template <typename T> static __device__ __forceinline__ void cut(const T *x, float *y, size_t n, int c, int wide) {
    size_t i = index();
    if (i < n) y[i] = get(x + i / c * wide + i % c);
}

// Weights (taps c, n) to filters (n, taps wide), zeros in the channels from c on. A block of 32 by 8 threads turns a tile of
// 32 by 32; rows = taps wide.
template <typename T> static __device__ __forceinline__ void fold(const float *w, T *out, int c, int wide, int rows, int n) {
    __shared__ float tile[32][33];
    int across = (n + 31) / 32, r0 = blockIdx.x / across * 32, k0 = blockIdx.x % across * 32, t = threadIdx.x;
    for (int i = threadIdx.y; i < 32; i += 8) {
        int r = r0 + i, j = r % wide;
        tile[i][t] = r < rows && k0 + t < n && j < c ? w[((size_t)(r / wide) * c + j) * n + k0 + t] : 0.0f;
    }
    __syncthreads();
    for (int i = threadIdx.y; i < 32; i += 8) {
        if (r0 + t < rows && k0 + i < n) put(out + (size_t)(k0 + i) * rows + r0 + t, tile[t][i]);
    }
}

// The way back, for the gradient.
template <typename T> static __device__ __forceinline__ void unfold(const T *x, float *w, int c, int wide, int rows, int n) {
    __shared__ float tile[32][33];
    int across = (n + 31) / 32, r0 = blockIdx.x / across * 32, k0 = blockIdx.x % across * 32, t = threadIdx.x;
    for (int i = threadIdx.y; i < 32; i += 8) {
        tile[i][t] = r0 + t < rows && k0 + i < n ? get(x + (size_t)(k0 + i) * rows + r0 + t) : 0.0f;
    }
    __syncthreads();
    for (int i = threadIdx.y; i < 32; i += 8) {
        int r = r0 + i, j = r % wide;
        if (r < rows && k0 + t < n && j < c) w[((size_t)(r / wide) * c + j) * n + k0 + t] = tile[t][i];
    }
}

#define FOR_CUDNN(SUFFIX, T)                                                                                                 \
    extern "C" __global__ void pad_##SUFFIX(const float *x, T *y, size_t n, int c, int wide) { pad<T>(x, y, n, c, wide); }   \
    extern "C" __global__ void cut_##SUFFIX(const T *x, float *y, size_t n, int c, int wide) { cut<T>(x, y, n, c, wide); }   \
    extern "C" __global__ void fold_##SUFFIX(const float *w, T *out, int c, int wide, int rows, int n) {                     \
        fold<T>(w, out, c, wide, rows, n);                                                                                   \
    }                                                                                                                        \
    extern "C" __global__ void unfold_##SUFFIX(const T *x, float *w, int c, int wide, int rows, int n) {                     \
        unfold<T>(x, w, c, wide, rows, n);                                                                                   \
    }
FOR_CUDNN(f32, float)
FOR_CUDNN(bf16, __nv_bfloat16)

// ------------------------------------------------------------------------------------------------------------------- sums

static __device__ float2 block_sum(float a, float b) {
    __shared__ float2 parts[32];
    for (int o = 16; o; o >>= 1) {
        a += __shfl_down_sync(0xffffffffu, a, o);
        b += __shfl_down_sync(0xffffffffu, b, o);
    }
    int lane = threadIdx.x & 31, warp = threadIdx.x >> 5, warps = blockDim.x >> 5;
    if (lane == 0) parts[warp] = make_float2(a, b);
    __syncthreads();
    if (warp == 0) {
        a = lane < warps ? parts[lane].x : 0.0f;
        b = lane < warps ? parts[lane].y : 0.0f;
        for (int o = 16; o; o >>= 1) {
            a += __shfl_down_sync(0xffffffffu, a, o);
            b += __shfl_down_sync(0xffffffffu, b, o);
        }
        if (lane == 0) parts[0] = make_float2(a, b);
    }
    __syncthreads();
    float2 sum = parts[0];
    __syncthreads();
    return sum;
}

// The sums of the columns of (rows, n). Blocks of 32 by 32 threads, 32 columns each.
extern "C" __global__ void column_sums(const float *x, float *out, int rows, int n) {
    __shared__ float parts[32][33];
    int column = blockIdx.x * 32 + threadIdx.x;
    float sum = 0;
    if (column < n) {
        for (int r = threadIdx.y; r < rows; r += 32) sum += x[(size_t)r * n + column];
    }
    parts[threadIdx.y][threadIdx.x] = sum;
    __syncthreads();
    if (threadIdx.y == 0 && column < n) {
        for (int r = 1; r < 32; ++r) sum += parts[r][threadIdx.x];
        out[column] = sum;
    }
}

// -------------------------------------------------------------------------------------------------------------- activations

static __device__ __forceinline__ float mish(float x) {
    float e = expf(fminf(x, 30.0f)), n = e * (e + 2.0f);
    return fmaxf(x, -87.0f) * (n / (n + 2.0f));
}

static __device__ __forceinline__ float mish_slope(float x) {
    float e = expf(fminf(x, 30.0f)), n = e * (e + 2.0f), w = n / (n + 2.0f);
    return fminf(fmaxf(x, -87.0f), 30.0f) * ((2.0f / (n + 2.0f)) * (1.0f + w) * (e / (1.0f + e))) + w;
}

// NaN stays NaN.
static __device__ __forceinline__ float relu(float x) { return x < 0.0f ? 0.0f : x; }

extern "C" __global__ void mish_forward(const float *x, float *y, size_t n) {
    size_t i = index();
    if (i < n) y[i] = mish(x[i]);
}
extern "C" __global__ void mish_backward(const float *x, const float *d, float *dx, size_t n) {
    size_t i = index();
    if (i < n) dx[i] = d[i] * mish_slope(x[i]);
}
extern "C" __global__ void relu_forward(const float *x, float *y, size_t n) {
    size_t i = index();
    if (i < n) y[i] = relu(x[i]);
}
extern "C" __global__ void relu_backward(const float *y, const float *d, float *dx, size_t n) {
    size_t i = index();
    if (i < n) dx[i] = y[i] > 0.0f ? d[i] : 0.0f;
}
extern "C" __global__ void add(const float *a, const float *b, float *y, size_t n) {
    size_t i = index();
    if (i < n) y[i] = a[i] + b[i];
}
extern "C" __global__ void multiply(const float *a, const float *b, float *y, size_t n) {
    size_t i = index();
    if (i < n) y[i] = a[i] * b[i];
}

// x scale + shift: x of n = (b, steps, c), e of (b, 2c).
extern "C" __global__ void film_forward(const float *x, const float *e, float *y, size_t n, int steps, int c) {
    size_t i = index();
    if (i >= n) return;
    const float *pair = e + i / ((size_t)steps * c) * 2 * c + i % c;
    y[i] = x[i] * pair[0] + pair[c];
}
// A thread a sample and channel: n = b c.
extern "C" __global__ void film_backward(const float *x, const float *e, const float *d, float *dx, float *de, size_t n,
                                         int steps, int c) {
    size_t i = index();
    if (i >= n) return;
    size_t b = i / c, j = i % c;
    float scale = e[b * 2 * c + j], d_scale = 0, d_shift = 0;
    for (int s = 0; s < steps; ++s) {
        size_t at = (b * steps + s) * c + j;
        d_scale += d[at] * x[at];
        d_shift += d[at];
        dx[at] = d[at] * scale;
    }
    de[b * 2 * c + j] = d_scale;
    de[b * 2 * c + c + j] = d_shift;
}

// Columns `at` to `at + w` of rows of `width`, from or to rows of w: n = rows w.
extern "C" __global__ void join(const float *x, float *y, size_t n, int w, int width, int at) {
    size_t i = index();
    if (i < n) y[i / w * width + at + i % w] = x[i];
}
extern "C" __global__ void split(const float *y, float *x, size_t n, int w, int width, int at) {
    size_t i = index();
    if (i < n) x[i] = y[i / w * width + at + i % w];
}

// Every row of w `times` times; n = rows times w.
extern "C" __global__ void repeat_forward(const float *x, float *y, size_t n, int times, int w) {
    size_t i = index();
    if (i < n) y[i] = x[i / w / times * w + i % w];
}
extern "C" __global__ void repeat_backward(const float *d, float *dx, size_t n, int times, int w) {
    size_t i = index();
    if (i >= n) return;
    float sum = 0;
    for (int t = 0; t < times; ++t) sum += d[(i / w * times + t) * w + i % w];
    dx[i] = sum;
}

// ----------------------------------------------------------------------------------------------------------- normalisation

enum Post { NONE, RELU, ADD_RELU, MISH, MISH_FILM, MISH_ADD };

#define EPS 1e-5f

// One block a sample and group. Threads lie in `ty` rows of `tx` channels; those beyond rest.
struct Place {
    int b, group, per, tx, ty, x, y;
    bool on;
};

static __device__ __forceinline__ Place place(int c, int groups) {
    Place p;
    p.b = blockIdx.x / groups;
    p.group = blockIdx.x % groups;
    p.per = c / groups;
    p.tx = min(p.per, (int)blockDim.x);
    p.ty = blockDim.x / p.tx;
    p.x = threadIdx.x % p.tx;
    p.y = threadIdx.x / p.tx;
    p.on = p.y < p.ty;
    return p;
}

// stats: mean and rate of each sample and group.
extern "C" __global__ void norm_forward(const float *x, const float *gain, const float *bias, const float *extra, float *out,
                                        float *stats, int s, int c, int groups, int post) {
    Place p = place(c, groups);
    size_t base = (size_t)p.b * s * c + p.group * p.per;
    float n = (float)s * (float)p.per, sum = 0;
    if (p.on) {
        for (int j = p.x; j < p.per; j += p.tx)
            for (int i = p.y; i < s; i += p.ty) sum += x[base + (size_t)i * c + j];
    }
    float mean = block_sum(sum, 0).x / n;
    sum = 0;
    if (p.on) {
        for (int j = p.x; j < p.per; j += p.tx)
            for (int i = p.y; i < s; i += p.ty) {
                float d = x[base + (size_t)i * c + j] - mean;
                sum += d * d;
            }
    }
    float rate = 1.0f / sqrtf(block_sum(sum, 0).x / n + EPS);
    if (threadIdx.x == 0) {
        stats[2 * blockIdx.x] = mean;
        stats[2 * blockIdx.x + 1] = rate;
    }
    if (!p.on) return;
    for (int j = p.x; j < p.per; j += p.tx) {
        int channel = p.group * p.per + j;
        float a = gain[channel], b = bias[channel], scale = 0, shift = 0;
        if (post == MISH_FILM) {
            scale = extra[(size_t)p.b * 2 * c + channel];
            shift = extra[(size_t)p.b * 2 * c + c + channel];
        }
        for (int i = p.y; i < s; i += p.ty) {
            size_t at = base + (size_t)i * c + j;
            float z = (x[at] - mean) * rate * a + b;
            switch (post) {
                case RELU: z = relu(z); break;
                case ADD_RELU: z = relu(z + extra[at]); break;
                case MISH: z = mish(z); break;
                case MISH_FILM: z = mish(z) * scale + shift; break;
                case MISH_ADD: z = mish(z) + extra[at]; break;
            }
            out[at] = z;
        }
    }
}

// The gradient of the normalised number z, from that of the result.
static __device__ __forceinline__ float through(int post, float d, float z, float y, float scale) {
    switch (post) {
        case RELU:
        case ADD_RELU: return y > 0.0f ? d : 0.0f;
        case MISH:
        case MISH_ADD: return d * mish_slope(z);
        case MISH_FILM: return d * scale * mish_slope(z);
        default: return d;
    }
}

// sums: (b, 2c), what each sample adds to the gradients of gains, then of biases. d_extra: of the residual before Relu, or of
// scales and shifts. Shared memory: four numbers a thread.
extern "C" __global__ void norm_backward(const float *x, const float *y, const float *gain, const float *bias,
                                         const float *extra, const float *stats, const float *dy, float *dx, float *sums,
                                         float *d_extra, int s, int c, int groups, int post) {
    extern __shared__ float shared[];
    Place p = place(c, groups);
    size_t base = (size_t)p.b * s * c + p.group * p.per;
    float mean = stats[2 * blockIdx.x], rate = stats[2 * blockIdx.x + 1];
    float n = (float)s * (float)p.per, all = 0, all_x = 0;
    bool film = post == MISH_FILM, rectified = post == RELU || post == ADD_RELU;
    for (int j0 = 0; j0 < p.per; j0 += p.tx) {
        int j = j0 + p.x, channel = p.group * p.per + j;
        bool on = p.on && j < p.per;
        float d_gain = 0, d_bias = 0, d_scale = 0, d_shift = 0;
        if (on) {
            float a = gain[channel], b = bias[channel];
            float scale = film ? extra[(size_t)p.b * 2 * c + channel] : 1.0f;
            for (int i = p.y; i < s; i += p.ty) {
                size_t at = base + (size_t)i * c + j;
                float normal = (x[at] - mean) * rate, z = normal * a + b, d = dy[at];
                float dz = through(post, d, z, rectified ? y[at] : 0.0f, scale);
                d_gain += dz * normal;
                d_bias += dz;
                if (film) {
                    d_scale += d * mish(z);
                    d_shift += d;
                }
            }
            all += d_bias * a;
            all_x += d_gain * a;
        }
        int t = blockDim.x;
        shared[threadIdx.x] = d_gain;
        shared[t + threadIdx.x] = d_bias;
        shared[2 * t + threadIdx.x] = d_scale;
        shared[3 * t + threadIdx.x] = d_shift;
        __syncthreads();
        if (on && p.y == 0) {
            for (int i = 1; i < p.ty; ++i) {
                d_gain += shared[i * p.tx + p.x];
                d_bias += shared[t + i * p.tx + p.x];
                d_scale += shared[2 * t + i * p.tx + p.x];
                d_shift += shared[3 * t + i * p.tx + p.x];
            }
            float *row = sums + (size_t)p.b * 2 * c + channel;
            row[0] = d_gain;
            row[c] = d_bias;
            if (film && d_extra) {
                row = d_extra + (size_t)p.b * 2 * c + channel;
                row[0] = d_scale;
                row[c] = d_shift;
            }
        }
        __syncthreads();
    }
    float2 both = block_sum(all, all_x);
    if (!p.on || !dx && !(post == ADD_RELU && d_extra)) return;
    float m = both.x / n, m_x = both.y / n;
    for (int j = p.x; j < p.per; j += p.tx) {
        int channel = p.group * p.per + j;
        float a = gain[channel], b = bias[channel];
        float scale = film ? extra[(size_t)p.b * 2 * c + channel] : 1.0f;
        for (int i = p.y; i < s; i += p.ty) {
            size_t at = base + (size_t)i * c + j;
            float normal = (x[at] - mean) * rate;
            float dz = through(post, dy[at], normal * a + b, rectified ? y[at] : 0.0f, scale);
            if (post == ADD_RELU && d_extra) d_extra[at] = dz;
            if (dx) dx[at] = rate * (dz * a - m - normal * m_x);
        }
    }
}

// ----------------------------------------------------------------------------------------------------------------- pooling

// The largest of every 3x3 window, step 2, border 1; once met, a NaN stays. n = b oh ow c.
extern "C" __global__ void max_forward(const float *x, float *y, Geo g, size_t n) {
    size_t i = index();
    if (i >= n) return;
    int c = g.c, j = i % c;
    size_t o = i / c, b = o / (g.oh * g.ow);
    float top = -INFINITY;
    for (int tap = 0; tap < 9; ++tap) {
        int p = under(g, o % (g.oh * g.ow), tap);
        if (p < 0) continue;
        float v = x[(b * g.h * g.w + p) * c + j];
        top = v > top || isnan(v) ? v : top;
    }
    y[i] = top;
}

// Of equal maxima the first takes the gradient. n = b h w c.
extern "C" __global__ void max_backward(const float *x, const float *y, const float *d, float *dx, Geo g, size_t n) {
    size_t i = index();
    if (i >= n) return;
    int c = g.c, j = i % c;
    size_t row = i / c, b = row / (g.h * g.w);
    float mine = x[i], sum = 0;
    for (int tap = 0; tap < 9; ++tap) {
        int o = over(g, row % (g.h * g.w), tap);
        if (o < 0) continue;
        size_t at = (b * g.oh * g.ow + o) * c + j;
        if (y[at] != mine) continue;
        bool first = true;
        for (int before = 0; before < tap && first; ++before) {
            int p = under(g, o, before);
            first = p < 0 || x[(b * g.h * g.w + p) * c + j] != mine;
        }
        if (first) sum += d[at];
    }
    dx[i] = sum;
}

// -1, .., 1 in n equal steps; -1 alone.
static __device__ __forceinline__ float position(int i, int n) { return n < 2 ? -1.0f : 2.0f * i / (n - 1) - 1.0f; }

// Logits (b, h, w, c) to attention, and pairs of expected positions. A thread a sample and channel: n = b c.
extern "C" __global__ void keypoints_forward(const float *x, float *attention, float *out, int h, int w, int c, size_t n) {
    size_t i = index();
    if (i >= n) return;
    size_t base = i / c * h * w * c + i % c;
    float top = -INFINITY, sum = 0, ex = 0, ey = 0;
    for (int p = 0; p < h * w; ++p) top = fmaxf(top, x[base + (size_t)p * c]);
    for (int p = 0; p < h * w; ++p) {
        float e = expf(x[base + (size_t)p * c] - top);
        attention[base + (size_t)p * c] = e;
        sum += e;
        ex += e * position(p % w, w);
        ey += e * position(p / w, h);
    }
    sum = 1.0f / sum;
    for (int p = 0; p < h * w; ++p) attention[base + (size_t)p * c] *= sum;
    out[2 * i] = ex * sum;
    out[2 * i + 1] = ey * sum;
}
// n = b h w c.
extern "C" __global__ void keypoints_backward(const float *attention, const float *out, const float *d, float *dx, int h, int w,
                                              int c, size_t n) {
    size_t i = index();
    if (i >= n) return;
    int p = i / c % (h * w);
    size_t at = (i / c / (h * w) * c + i % c) * 2;
    dx[i] = attention[i] * (d[at] * (position(p % w, w) - out[at]) + d[at + 1] * (position(p / w, h) - out[at + 1]));
}

// -------------------------------------------------------------------------------------------------------------------- loss

// The weighted sum of squared differences times `scale`, in one block. `weights` of rows of `width`, or null.
extern "C" __global__ void squared_error(const float *a, const float *b, const float *weights, float *out, size_t n, int width,
                                         float scale) {
    float sum = 0;
    for (size_t i = threadIdx.x; i < n; i += blockDim.x) {
        float d = a[i] - b[i];
        sum += (weights ? weights[i / width] : 1.0f) * d * d;
    }
    sum = block_sum(sum, 0).x;
    if (threadIdx.x == 0) *out = sum * scale;
}
// For the first argument; for the second the two change places. `d` is the gradient of the loss.
extern "C" __global__ void squared_error_backward(const float *a, const float *b, const float *weights, const float *d,
                                                  float *da, size_t n, int width, float scale) {
    size_t i = index();
    if (i < n) da[i] = 2.0f * scale * *d * (weights ? weights[i / width] : 1.0f) * (a[i] - b[i]);
}

// --------------------------------------------------------------------------------------------------------------- optimiser

// All parameters in one launch: for each of `count` its pointers (`kinds` of them), its numbers and its first block.
#define CHUNK 8192

static __device__ __forceinline__ int find(const uint64_t *firsts, int count) {
    int low = 0, high = count - 1;
    while (low < high) {
        int middle = (low + high + 1) / 2;
        if (firsts[middle] <= blockIdx.x) low = middle;
        else high = middle - 1;
    }
    return low;
}

// What a block has to do: the first number of its parameter and how many.
static __device__ __forceinline__ const uint64_t *task(const uint64_t *table, int count, int kinds, size_t *first, int *n) {
    int t = find(table + (size_t)(kinds + 1) * count, count);
    *first = (blockIdx.x - table[(size_t)(kinds + 1) * count + t]) * CHUNK;
    uint64_t left = table[(size_t)kinds * count + t] - *first;
    *n = left < CHUNK ? (int)left : CHUNK;
    return table + t;
}

extern "C" __global__ void squares(const uint64_t *table, int count, float *parts) {
    size_t first;
    int n;
    const uint64_t *t = task(table, count, 1, &first, &n);
    const float *g = (const float *)t[0] + first;
    float sum = 0;
    for (int i = threadIdx.x; i < n; i += blockDim.x) sum += g[i] * g[i];
    sum = block_sum(sum, 0).x;
    if (threadIdx.x == 0) parts[blockIdx.x] = sum;
}

// The root of the sum of `n` parts, in one block.
extern "C" __global__ void root(const float *parts, float *norm, int n) {
    __shared__ double sums[256];
    double sum = 0;
    for (int i = threadIdx.x; i < n; i += blockDim.x) sum += parts[i];
    sums[threadIdx.x] = sum;
    __syncthreads();
    for (int o = 128; o; o >>= 1) {
        if (threadIdx.x < o) sums[threadIdx.x] += sums[threadIdx.x + o];
        __syncthreads();
    }
    if (threadIdx.x == 0) *norm = (float)sqrt(sums[0]);
}

// The numbers of a step, as in kernel/optim.rs; `longest` is the norm that gradients are cut to, infinite for none.
extern "C" __global__ void adam(const uint64_t *table, int count, const float *norm, float rate, float beta1, float beta2,
                                float eps, float root, float longest, float decay, float keep) {
    float length = *norm;
    if (!isfinite(length)) return;
    float clip = fminf(longest / (length + 1e-6f), 1.0f);
    size_t first;
    int n;
    const uint64_t *t = task(table, count, 4, &first, &n);
    float *p = (float *)t[0] + first, *m = (float *)t[2 * (size_t)count] + first, *v = (float *)t[3 * (size_t)count] + first;
    const float *grad = (const float *)t[(size_t)count] + first;
    for (int i = threadIdx.x; i < n; i += blockDim.x) {
        float now = p[i], g = grad[i] * clip + decay * now;
        float mean = beta1 * m[i] + (1.0f - beta1) * g, square = beta2 * v[i] + (1.0f - beta2) * g * g;
        m[i] = mean;
        v[i] = square;
        p[i] = now * keep - rate * mean / (sqrtf(square) * root + eps);
    }
}

// average += part (p - average).
extern "C" __global__ void blend(const uint64_t *table, int count, float part) {
    size_t first;
    int n;
    const uint64_t *t = task(table, count, 2, &first, &n);
    float *average = (float *)t[0] + first;
    const float *p = (const float *)t[(size_t)count] + first;
    for (int i = threadIdx.x; i < n; i += blockDim.x) average[i] = part < 1.0f ? average[i] + part * (p[i] - average[i]) : p[i];
}
