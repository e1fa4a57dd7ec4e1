/* The learner's layers on one core: GRU over a sequence and [linear, activation, LayerNorm], forward and backward.
 *
 * Plain C with the vector extensions of GCC and clang. All matrices are row-major float32 and may lie at any address.
 * A result's bits depend on the numbers that went in alone: every sum runs in one fixed order, whatever the alignment,
 * the row's place in a block or the thread.
 *
 * Products run on register tiles of ROWS x COLUMNS. Their right operand is packed once per call into panels of COLUMNS
 * columns, zero-padded; a panel's block of DEPTH rows stays in the first-level cache while the rows pass by it.
 */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__GLIBC__)
#include <malloc.h>
#endif
#if defined(__SSE__)
#include <immintrin.h>
#endif

enum { LANES = 8, ROWS = 6, COLUMNS = 2 * LANES, DEPTH = 256, BLOCK = 48 };
enum { IDENTITY = 0, RELU = 1, TANH = 2 };

typedef float vec __attribute__((vector_size(LANES * 4)));
typedef int32_t ivec __attribute__((vector_size(LANES * 4)));
typedef float unaligned_vec __attribute__((vector_size(LANES * 4), aligned(4), may_alias));

#define INLINE static inline __attribute__((always_inline))

INLINE vec load(const float *p) { return *(const unaligned_vec *)p; }

INLINE void store(float *p, vec v) { *(unaligned_vec *)p = v; }

INLINE vec all(float x) { return (vec){x, x, x, x, x, x, x, x}; }

/* The first n floats at p, then zeros; n may exceed LANES. */
INLINE vec load_upto(const float *p, long n) {
    if (n >= LANES)
        return load(p);
#if defined(__AVX2__)
    const __m256i lane = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
    return _mm256_maskload_ps(p, _mm256_cmpgt_epi32(_mm256_set1_epi32((int)n), lane));
#else
    vec v = all(0);
    for (long i = 0; i < n; i++)
        v[i] = p[i];
    return v;
#endif
}

INLINE void store_upto(float *p, vec v, long n) {
    if (n >= LANES)
        store(p, v);
    else
        for (long i = 0; i < n; i++)
            p[i] = v[i];
}

/* Runs the statements for j = 0, LANES, ... < n; `lanes` is how many of the vector at j there are. */
#define FOR_EACH_VECTOR(n, ...)                                                                                        \
    do {                                                                                                               \
        long j = 0;                                                                                                    \
        for (; j + LANES <= (n); j += LANES) {                                                                         \
            enum { lanes = LANES };                                                                                    \
            __VA_ARGS__                                                                                                \
        }                                                                                                              \
        if (j < (n)) {                                                                                                 \
            const long lanes = (n) - j;                                                                                \
            __VA_ARGS__                                                                                                \
        }                                                                                                              \
    } while (0)

INLINE void add_to(float *p, vec v, long n) { store_upto(p, load_upto(p, n) + v, n); }

INLINE float sum_of(vec v) { return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7])); }

INLINE vec choose(ivec condition, vec yes, vec no) {
    return (vec)((condition & (ivec)yes) | (~condition & (ivec)no));
}

/* A NaN stays one. */
INLINE vec clamp(vec x, float limit) {
#if defined(__AVX__)
    return _mm256_max_ps(all(-limit), _mm256_min_ps(all(limit), x));
#else
    x = choose(x > all(limit), all(limit), x);
    return choose(x < all(-limit), all(-limit), x);
#endif
}

/* Splits y = k ln(2) + f with |f| <= ln(2) / 2. Returns f; `power` takes k in the bits of a float's exponent. */
INLINE vec reduce(vec y, ivec *power) {
    const vec round_to_integer = all(12582912.0f); /* 1.5 * 2^23: adding it leaves the integer in the low bits */
    vec shifted = y * all(1.44269504f) + round_to_integer;
    vec k = shifted - round_to_integer;
    *power = (ivec)shifted << 23;
    return y - k * all(0.693359375f) + k * all(2.12194440e-4f);
}

/* To 1e-7 relative; e^-x by its Chebyshev polynomial of degree 5. */
INLINE vec sigmoid_of(vec x) {
    ivec power;
    vec f = reduce(clamp(-x, 87), &power);
    vec e = f * all(0.008296807f) + all(0.04194099f);
    e = e * f + all(0.16667749f);
    e = e * f + all(0.4999862f);
    e = e * f + all(0.9999996f);
    e = e * f + all(1.0000001f);
    return all(1) / (all(1) + (vec)((ivec)e + power));
}

/* To 1e-7 relative, near zero too: (e^2x - 1) / (e^2x + 1), with e^2x - 1 = 2^k (e^f - 1) + (2^k - 1). */
INLINE vec tanh_of(vec x) {
    ivec power;
    vec f = reduce(clamp(x + x, 40), &power);
    vec series = f * all(1.0f / 5040) + all(1.0f / 720);
    series = series * f + all(1.0f / 120);
    series = series * f + all(1.0f / 24);
    series = series * f + all(1.0f / 6);
    series = series * f + all(0.5f);
    series = series * (f * f) + f;
    vec scale = (vec)(power + 0x3f800000);
    vec e = scale * series + (scale - all(1));
    return e / (e + all(2));
}

/* Numbers below 1e-38 count as zero during a call: on some processors they cost a hundred times more. */
static unsigned long begin_flush(void) {
#if defined(__SSE__)
    unsigned mode = _mm_getcsr();
    _mm_setcsr(mode | 0x8040);
    return mode;
#elif defined(__aarch64__)
    unsigned long mode;
    __asm__ volatile("mrs %0, fpcr" : "=r"(mode));
    __asm__ volatile("msr fpcr, %0" ::"r"(mode | (1UL << 24)));
    return mode;
#else
    return 0;
#endif
}

static void end_flush(unsigned long mode) {
#if defined(__SSE__)
    _mm_setcsr((unsigned)mode);
#elif defined(__aarch64__)
    __asm__ volatile("msr fpcr, %0" ::"r"(mode));
#else
    (void)mode;
#endif
}

/* Makes the process keep memory it has freed: the learner allocates the same megabytes for every shard, and giving them
 * back in between costs a page fault per four kilobytes. */
void keep_freed_memory(void) {
#if defined(__GLIBC__)
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 1 << 30);
#endif
}

static long min(long a, long b) { return a < b ? a : b; }

static long round_up(long n, long multiple) { return (n + multiple - 1) / multiple * multiple; }

/* One allocation per call, handed out piece by piece; `measure` first adds up what the pieces need. */
typedef struct {
    char *base;
    size_t used;
} Arena;

static float *take(Arena *arena, long floats) {
    float *piece = arena->base ? (float *)(arena->base + arena->used) : NULL;
    arena->used += (size_t)round_up(floats * 4, 64);
    return piece;
}

static int begin_arena(Arena *arena) {
    arena->base = aligned_alloc(64, arena->used ? arena->used : 64);
    arena->used = 0;
    return arena->base != NULL;
}

/* Products. */

/* c[rows, COLUMNS] = (or +=) sum over k of a[row, k] * b[k, :], with a at a[row * row_step + k * k_step]. */
INLINE void tile(const int rows, long K, const float *a, long row_step, long k_step, const float *b, float *c, long ldc,
                 int accumulate) {
    vec sum[ROWS][2];
    for (int r = 0; r < rows; r++) {
        __builtin_prefetch(c + r * ldc, 1);
        __builtin_prefetch(c + r * ldc + COLUMNS - 1, 1);
        for (int half = 0; half < 2; half++)
            sum[r][half] = all(0);
    }
#pragma GCC unroll 4
    for (long k = 0; k < K; k++) {
        vec left = *(const vec *)b, right = *(const vec *)(b + LANES);
        for (int r = 0; r < rows; r++) {
            vec x = all(a[r * row_step]);
            sum[r][0] += x * left;
            sum[r][1] += x * right;
        }
        a += k_step;
        b += COLUMNS;
    }
    for (int r = 0; r < rows; r++)
        for (int half = 0; half < 2; half++)
            store(c + r * ldc + half * LANES, accumulate ? load(c + r * ldc + half * LANES) + sum[r][half]
                                                       : sum[r][half]);
}

#define FOR_EACH_ROW_COUNT(rows, call)                                                                                 \
    switch (rows) {                                                                                                    \
    case 6: call(6); break;                                                                                            \
    case 5: call(5); break;                                                                                            \
    case 4: call(4); break;                                                                                            \
    case 3: call(3); break;                                                                                            \
    case 2: call(2); break;                                                                                            \
    case 1: call(1); break;                                                                                            \
    }

static void row_major_tile(long rows, long K, const float *a, long lda, const float *b, float *c, long ldc,
                           int accumulate) {
#define CALL(n) tile(n, K, a, lda, 1, b, c, ldc, accumulate)
    FOR_EACH_ROW_COUNT(rows, CALL)
#undef CALL
}

static void packed_tile(long rows, long K, const float *a, const float *b, float *c, long ldc) {
#define CALL(n) tile(n, K, a, 1, ROWS, b, c, ldc, 1)
    FOR_EACH_ROW_COUNT(rows, CALL)
#undef CALL
}

/* c[M, COLUMNS] = (or +=) a[M, K] panel[K, COLUMNS]. */
static void times_panel(long M, long K, const float *a, long lda, const float *panel, float *c, long ldc,
                        int accumulate) {
    for (long k = 0; k < K; k += DEPTH)
        for (long row = 0; row < M; row += ROWS)
            row_major_tile(min(ROWS, M - row), min(DEPTH, K - k), a + row * lda + k, lda, panel + k * COLUMNS,
                           c + row * ldc, ldc, accumulate || k);
    if (K == 0 && !accumulate)
        for (long row = 0; row < M; row++)
            memset(c + row * ldc, 0, COLUMNS * sizeof(float));
}

static void copy_rows(long rows, long columns, const float *from, long from_step, float *to, long to_step) {
    for (long row = 0; row < rows; row++)
        memcpy(to + row * to_step, from + row * from_step, (size_t)columns * sizeof(float));
}

/* c[M, N] = (or +=) a[M, K] b[K, N], b packed; M <= BLOCK. */
static void times_packed(long M, long N, long K, const float *a, long lda, const float *b, float *c, long ldc,
                         int accumulate) {
    float edge[BLOCK * COLUMNS];
    for (long column = 0; column < N; column += COLUMNS, b += K * COLUMNS) {
        long columns = min(COLUMNS, N - column);
        if (columns == COLUMNS) {
            times_panel(M, K, a, lda, b, c + column, ldc, accumulate);
        } else {
            if (accumulate)
                copy_rows(M, columns, c + column, ldc, edge, COLUMNS);
            times_panel(M, K, a, lda, b, edge, COLUMNS, accumulate);
            copy_rows(M, columns, edge, COLUMNS, c + column, ldc);
        }
    }
}

static long packed_size(long K, long N) { return K * round_up(N, COLUMNS); }

/* Panels of matrix[K, N]; a panel has room for `capacity` rows. */
static void pack(long K, long N, const float *matrix, long ld, float *panels, long capacity) {
    for (long column = 0; column < N; column += COLUMNS, panels += capacity * COLUMNS) {
        const float *from = matrix + column;
        const long columns = N - column;
        float *to = panels;
        if (columns >= COLUMNS)
            for (long k = 0; k < K; k++, from += ld, to += COLUMNS) {
                store(to, load(from));
                store(to + LANES, load(from + LANES));
            }
        else
            for (long k = 0; k < K; k++, from += ld, to += COLUMNS) {
                store(to, load_upto(from, columns));
                store(to + LANES, columns > LANES ? load_upto(from + LANES, columns - LANES) : all(0));
            }
    }
}

/* One panel of the transpose of matrix[columns, K], columns <= COLUMNS. */
static void pack_transposed_panel(long K, long columns, const float *matrix, long ld, float *panel) {
    for (long k = 0; k < K; k++)
        for (long column = 0; column < COLUMNS; column++)
            panel[k * COLUMNS + column] = column < columns ? matrix[column * ld + k] : 0;
}

static void pack_transposed(long K, long N, const float *matrix, float *panels) {
    for (long column = 0; column < N; column += COLUMNS)
        pack_transposed_panel(K, min(COLUMNS, N - column), matrix + column * K, K, panels + column * K);
}

/* Sums of outer products, collected until DEPTH rows are there: gradient[M, N] += left[rows, M]^T right[rows, N]. */

/* Panels of ROWS columns of matrix[K, M]; each panel has room for DEPTH rows and a vector's overhang. */
enum { LEFT_PANEL = DEPTH * ROWS + LANES };

static long left_size(long M) { return round_up(M, ROWS) / ROWS * LEFT_PANEL; }

static void pack_left(long K, long M, const float *matrix, long ld, float *panels) {
    for (long k = 0; k < K; k++, matrix += ld, panels += ROWS) {
        float *to = panels;
        long column = 0;
        for (; column + LANES <= M; column += ROWS, to += LEFT_PANEL) /* the next row overwrites what is too much */
            store(to, load(matrix + column));
        for (; column < M; column += ROWS, to += LEFT_PANEL)
            for (long i = 0; i < ROWS; i++)
                to[i] = column + i < M ? matrix[column + i] : 0;
    }
}

static void add_outer(long M, long N, long K, const float *left, const float *right, float *gradient) {
    float edge[ROWS * COLUMNS];
    for (long column = 0; column < N; column += COLUMNS, right += DEPTH * COLUMNS) {
        long columns = min(COLUMNS, N - column);
        const float *a = left;
        for (long row = 0; row < M; row += ROWS, a += LEFT_PANEL) {
            long rows = min(ROWS, M - row);
            float *c = gradient + row * N + column;
            if (columns == COLUMNS) {
                packed_tile(rows, K, a, right, c, N);
            } else {
                copy_rows(rows, columns, c, N, edge, COLUMNS);
                packed_tile(rows, K, a, right, edge, COLUMNS);
                copy_rows(rows, columns, edge, COLUMNS, c, N);
            }
        }
    }
}

/* GRU. */

/* The state before a step: that after the step before, or zero where an episode starts. */
static void state_before(long rows, long H, const float *states, const uint8_t *start, float *before) {
    for (long row = 0; row < rows; row++)
        if (start[row])
            memset(before + row * H, 0, (size_t)H * sizeof(float));
        else
            memcpy(before + row * H, states + row * H, (size_t)H * sizeof(float));
}

typedef struct {
    float *weights;  /* per panel of H and gate: input part [I, COLUMNS], state part [H, COLUMNS] */
    float *before;   /* [BLOCK, H] */
    float *products; /* reset, update, candidate from the input, candidate from the state: [4, BLOCK, COLUMNS] */
} GruForward;

static GruForward gru_forward_scratch(Arena *arena, long I, long H) {
    GruForward s;
    s.weights = take(arena, 3 * (packed_size(I, H) + packed_size(H, H)));
    s.before = take(arena, BLOCK * H);
    s.products = take(arena, 4 * BLOCK * COLUMNS);
    return s;
}

/* Gates, candidate and new state of a panel of at most COLUMNS units; products as in GruForward. In two passes, so that
 * the processor has many short chains of operations to overlap. */
static void gates_panel(long rows, long columns, long H, float *products, const float *before, const float *bias_ih,
                        const float *bias_hh, float *states, float *gates) {
    float *const update_products = products + BLOCK * COLUMNS;
    const float *const from_inputs = products + 2 * BLOCK * COLUMNS;
    const float *const from_states = products + 3 * BLOCK * COLUMNS;
    FOR_EACH_VECTOR(columns, {
        const vec reset_bias = load_upto(bias_ih + j, lanes) + load_upto(bias_hh + j, lanes);
        const vec update_bias = load_upto(bias_ih + H + j, lanes) + load_upto(bias_hh + H + j, lanes);
        const vec input_bias = load_upto(bias_ih + 2 * H + j, lanes);
        const vec state_bias = load_upto(bias_hh + 2 * H + j, lanes);
        for (long at = j; at < rows * COLUMNS; at += COLUMNS) {
            store(products + at, sigmoid_of(load(products + at) + reset_bias));
            store(update_products + at, sigmoid_of(load(update_products + at) + update_bias));
        }
        for (long row = 0; row < rows; row++) {
            const long at = row * COLUMNS + j;
            vec reset = load(products + at), update = load(update_products + at);
            vec from_state = load(from_states + at) + state_bias;
            vec candidate = tanh_of(load(from_inputs + at) + input_bias + reset * from_state);
            vec old = load_upto(before + row * H + j, lanes);
            store_upto(states + row * H + j, candidate + update * (old - candidate), lanes);
            if (gates) {
                float *saved = gates + row * 4 * H + j;
                store_upto(saved, candidate, lanes);
                store_upto(saved + H, reset, lanes);
                store_upto(saved + 2 * H, update, lanes);
                store_upto(saved + 3 * H, from_state, lanes);
            }
        }
    });
}

/* States [L, R, H] after each step; gates, unless NULL: [L, R, 4 H] candidate, reset, update, candidate from the state.
 * inputs [L, R, I], initial [R, H], start [L, R], weight_ih [3 H, I], weight_hh [3 H, H], bias_ih, bias_hh [3 H] in the
 * order reset, update, candidate. Returns 0, or 1 if there is no memory. */
int gru_forward(long L, long R, long I, long H, const float *inputs, const float *initial, const uint8_t *start,
                const float *weight_ih, const float *weight_hh, const float *bias_ih, const float *bias_hh,
                float *states, float *gates) {
    Arena arena = {0};
    gru_forward_scratch(&arena, I, H);
    if (!begin_arena(&arena))
        return 1;
    GruForward s = gru_forward_scratch(&arena, I, H);
    unsigned long mode = begin_flush();
    const long panel = (I + H) * COLUMNS;
    for (long column = 0, p = 0; column < H; column += COLUMNS)
        for (long gate = 0; gate < 3; gate++, p++) {
            long columns = min(COLUMNS, H - column), first = gate * H + column;
            pack_transposed_panel(I, columns, weight_ih + first * I, I, s.weights + p * panel);
            pack_transposed_panel(H, columns, weight_hh + first * H, H, s.weights + p * panel + I * COLUMNS);
        }
    for (long first = 0; first < R; first += BLOCK) {
        const long rows = min(BLOCK, R - first);
        for (long t = 0; t < L; t++) {
            const long at = t * R + first;
            const float *x = inputs + at * I;
            state_before(rows, H, t ? states + (at - R) * H : initial + first * H, start + at, s.before);
            const float *weights = s.weights;
            for (long column = 0; column < H; column += COLUMNS) {
                for (long gate = 0; gate < 3; gate++, weights += panel) {
                    float *from_input = s.products + gate * BLOCK * COLUMNS;
                    float *from_state = gate < 2 ? from_input : from_input + BLOCK * COLUMNS;
                    times_panel(rows, I, x, I, weights, from_input, COLUMNS, 0);
                    times_panel(rows, H, s.before, H, weights + I * COLUMNS, from_state, COLUMNS, gate < 2);
                }
                gates_panel(rows, min(COLUMNS, H - column), H, s.products, s.before + column, bias_ih + column,
                            bias_hh + column, states + at * H + column, gates ? gates + at * 4 * H + column : NULL);
            }
        }
    }
    end_flush(mode);
    free(arena.base);
    return 0;
}

typedef struct {
    float *weight_ih, *weight_hh;      /* packed; weight_ih with the candidate's rows first */
    float *before, *carried;           /* [BLOCK, H] */
    float *gates;                      /* [BLOCK, 4 H] gradients: candidate, reset, update, candidate from the state */
    float *candidate, *middle, *state; /* the same packed: [H], [2 H], [H] columns */
    float *inputs_right, *before_right;
    float *bias;                       /* [4 H] */
} GruBackward;

static GruBackward gru_backward_scratch(Arena *arena, long I, long H) {
    GruBackward s;
    s.weight_ih = take(arena, packed_size(3 * H, I));
    s.weight_hh = take(arena, packed_size(3 * H, H));
    s.before = take(arena, BLOCK * H);
    s.carried = take(arena, BLOCK * H);
    s.gates = take(arena, BLOCK * 4 * H);
    s.candidate = take(arena, left_size(H));
    s.middle = take(arena, left_size(2 * H));
    s.state = take(arena, left_size(H));
    s.inputs_right = take(arena, packed_size(DEPTH, I));
    s.before_right = take(arena, packed_size(DEPTH, H));
    s.bias = take(arena, 4 * H);
    return s;
}

/* Gradients of what gru_forward computed, from those of its states; the other names as there.
 * grad_inputs and grad_initial may be NULL. */
int gru_backward(long L, long R, long I, long H, const float *inputs, const float *initial, const uint8_t *start,
                 const float *weight_ih, const float *weight_hh, const float *states, const float *gates,
                 const float *grad_states, float *grad_inputs, float *grad_initial, float *grad_weight_ih,
                 float *grad_weight_hh, float *grad_bias_ih, float *grad_bias_hh) {
    Arena arena = {0};
    gru_backward_scratch(&arena, I, H);
    if (!begin_arena(&arena))
        return 1;
    GruBackward s = gru_backward_scratch(&arena, I, H);
    unsigned long mode = begin_flush();
    for (long column = 0; column < I && grad_inputs; column += COLUMNS) {
        float *panel = s.weight_ih + 3 * H * column;
        const long columns = min(COLUMNS, I - column);
        pack(H, columns, weight_ih + 2 * H * I + column, I, panel, H);
        pack(2 * H, columns, weight_ih + column, I, panel + H * COLUMNS, 2 * H);
    }
    pack(3 * H, H, weight_hh, H, s.weight_hh, 3 * H);
    memset(grad_weight_ih, 0, (size_t)(3 * H * I) * sizeof(float));
    memset(grad_weight_hh, 0, (size_t)(3 * H * H) * sizeof(float));
    memset(s.bias, 0, (size_t)(4 * H) * sizeof(float));
    long filled = 0;
    for (long first = 0; first < R; first += BLOCK) {
        const long rows = min(BLOCK, R - first);
        memset(s.carried, 0, (size_t)(rows * H) * sizeof(float));
        for (long t = L - 1; t >= 0; t--) {
            const long at = t * R + first;
            state_before(rows, H, t ? states + (at - R) * H : initial + first * H, start + at, s.before);
            for (long row = 0; row < rows; row++) {
                const float *saved = gates + (at + row) * 4 * H, *incoming = grad_states + (at + row) * H;
                float *out = s.gates + row * 4 * H, *carried = s.carried + row * H, *before = s.before + row * H;
                FOR_EACH_VECTOR(H, {
                    vec candidate = load_upto(saved + j, lanes), reset = load_upto(saved + H + j, lanes);
                    vec update = load_upto(saved + 2 * H + j, lanes), from_state = load_upto(saved + 3 * H + j, lanes);
                    vec grad = load_upto(carried + j, lanes) + load_upto(incoming + j, lanes);
                    vec kept = grad * update;
                    vec to_candidate = (grad - kept) * (all(1) - candidate * candidate);
                    vec to_state = to_candidate * reset;
                    vec to_reset = to_state * from_state * (all(1) - reset);
                    vec to_update = kept * (load_upto(before + j, lanes) - candidate) * (all(1) - update);
                    store_upto(carried + j, kept, lanes);
                    store_upto(out + j, to_candidate, lanes);
                    store_upto(out + H + j, to_reset, lanes);
                    store_upto(out + 2 * H + j, to_update, lanes);
                    store_upto(out + 3 * H + j, to_state, lanes);
                    add_to(s.bias + j, to_candidate, lanes);
                    add_to(s.bias + H + j, to_reset, lanes);
                    add_to(s.bias + 2 * H + j, to_update, lanes);
                    add_to(s.bias + 3 * H + j, to_state, lanes);
                });
            }
            if (grad_inputs)
                times_packed(rows, I, 3 * H, s.gates, 4 * H, s.weight_ih, grad_inputs + at * I, I, 0);
            if (t || grad_initial)
                times_packed(rows, H, 3 * H, s.gates + H, 4 * H, s.weight_hh, s.carried, H, 1);
            for (long row = 0; row < rows; row++)
                if (start[at + row])
                    memset(s.carried + row * H, 0, (size_t)H * sizeof(float));
            pack_left(rows, H, s.gates, 4 * H, s.candidate + filled * ROWS);
            pack_left(rows, 2 * H, s.gates + H, 4 * H, s.middle + filled * ROWS);
            pack_left(rows, H, s.gates + 3 * H, 4 * H, s.state + filled * ROWS);
            pack(rows, I, inputs + at * I, I, s.inputs_right + filled * COLUMNS, DEPTH);
            pack(rows, H, s.before, H, s.before_right + filled * COLUMNS, DEPTH);
            filled += rows;
            const long next = t ? rows : min(BLOCK, R - first - rows);
            if (filled + next > DEPTH || next <= 0) {
                add_outer(2 * H, I, filled, s.middle, s.inputs_right, grad_weight_ih);
                add_outer(H, I, filled, s.candidate, s.inputs_right, grad_weight_ih + 2 * H * I);
                add_outer(2 * H, H, filled, s.middle, s.before_right, grad_weight_hh);
                add_outer(H, H, filled, s.state, s.before_right, grad_weight_hh + 2 * H * H);
                filled = 0;
            }
        }
        if (grad_initial)
            memcpy(grad_initial + first * H, s.carried, (size_t)(rows * H) * sizeof(float));
    }
    memcpy(grad_bias_ih, s.bias + H, (size_t)(2 * H) * sizeof(float));
    memcpy(grad_bias_ih + 2 * H, s.bias, (size_t)H * sizeof(float));
    memcpy(grad_bias_hh, s.bias + H, (size_t)(3 * H) * sizeof(float));
    end_flush(mode);
    free(arena.base);
    return 0;
}

/* [linear, activation, LayerNorm]. */

INLINE vec activate(vec x, int activation) {
    return activation == RELU ? choose(x < all(0), all(0), x) : activation == TANH ? tanh_of(x) : x;
}

/* d activate / dx from its result. */
INLINE vec slope(vec activated, int activation) {
    return activation == RELU   ? choose(activated > all(0), all(1), all(0))
           : activation == TANH ? all(1) - activated * activated
                                : all(1);
}

/* LayerNorm of a block of rows takes three passes over all of them, not row by row: a row's sums are chains of
 * dependent additions, and the processor overlaps those of several rows. A row's statistics are its mean and the
 * inverse of its deviation. */

/* One row plus bias (unless NULL), activated; into `to`, unless NULL. */
INLINE void activate_row(long O, const int activation, const float *from, const float *bias, float *to,
                         float *statistics) {
    vec sum = all(0);
    FOR_EACH_VECTOR(O, {
        vec x = load_upto(from + j, lanes);
        if (bias)
            x += load_upto(bias + j, lanes);
        x = activate(x, activation);
        sum += x;
        if (to)
            store_upto(to + j, x, lanes);
    });
    statistics[0] = sum_of(sum) / (float)O;
}

static void normalise(long rows, long O, const float *from, const float *scale, const float *shift, float *statistics,
                      float *y) {
    for (long row = 0; row < rows; row++) {
        const float *x = from + row * O;
        const vec mean = all(statistics[2 * row]);
        vec squares = all(0);
        FOR_EACH_VECTOR(O, {
            vec centred = load_upto(x + j, lanes) - mean;
            if ((long)lanes < LANES)
                centred = load_upto((const float *)&centred, lanes); /* what is beyond the row must not count */
            squares += centred * centred;
        });
        statistics[2 * row + 1] = 1 / __builtin_sqrtf(sum_of(squares) / (float)O + 1e-5f);
    }
    for (long row = 0; row < rows; row++) {
        const vec mean = all(statistics[2 * row]), inverse_deviation = all(statistics[2 * row + 1]);
        FOR_EACH_VECTOR(O, {
            vec normal = (load_upto(from + row * O + j, lanes) - mean) * inverse_deviation;
            store_upto(y + row * O + j, normal * load_upto(scale + j, lanes) + load_upto(shift + j, lanes), lanes);
        });
    }
}

#define FOR_ACTIVATION(activation, call)                                                                               \
    if (activation == RELU)                                                                                            \
        call(RELU);                                                                                                    \
    else if (activation == TANH)                                                                                       \
        call(TANH);                                                                                                    \
    else                                                                                                               \
        call(IDENTITY);

/* y[T, O] = LayerNorm(activation(x weight^T + bias)).
 * x [T, I]. weight [O, I] or NULL: x itself, I = O. bias [O] or NULL. scale, shift [O], or both NULL: no LayerNorm.
 * For layer_backward: activated [T, O] and statistics [T, 2], or NULL; `activated` is not written, and need not be
 * there, where it would equal x or y. Returns 0, or 1 if there is no memory. */
int layer_forward(long T, long I, long O, long activation, const float *x, const float *weight, const float *bias,
                  const float *scale, const float *shift, float *activated, float *statistics, float *y) {
    Arena arena = {0};
    take(&arena, weight ? packed_size(I, O) : 0);
    if (!begin_arena(&arena))
        return 1;
    float *packed = take(&arena, weight ? packed_size(I, O) : 0);
    unsigned long mode = begin_flush();
    if (weight)
        pack_transposed(I, O, weight, packed);
    const int as_it_is = !weight && activation == IDENTITY && scale;
    float own_statistics[2 * BLOCK];
    for (long first = 0; first < T; first += BLOCK) {
        const long rows = min(BLOCK, T - first);
        float *middle = (activated && scale && !as_it_is ? activated : y) + first * O;
        float *pairs = statistics ? statistics + 2 * first : own_statistics;
        if (weight)
            times_packed(rows, O, I, x + first * I, I, packed, middle, O, 0);
        const float *from = weight ? middle : x + first * O;
        for (long row = 0; row < rows; row++) {
#define CALL(kind) activate_row(O, kind, from + row * O, bias, as_it_is ? NULL : middle + row * O, pairs + 2 * row)
            FOR_ACTIVATION(activation, CALL)
#undef CALL
        }
        if (scale)
            normalise(rows, O, as_it_is ? from : middle, scale, shift, pairs, y + first * O);
    }
    end_flush(mode);
    free(arena.base);
    return 0;
}

/* What the LayerNorms of a block of rows add to the gradients of scale and shift, and for each row the means over the
 * normalised units of their gradients and of these times the units. */
static void normalise_backward(long rows, long O, const float *activated, const float *statistics, const float *scale,
                               const float *grad_y, float *grad_scale, float *grad_shift, float *means) {
    for (long row = 0; row < rows; row++, activated += O, grad_y += O) {
        const vec mean = all(statistics[2 * row]), inverse_deviation = all(statistics[2 * row + 1]);
        vec sum = all(0), sum_product = all(0);
        FOR_EACH_VECTOR(O, {
            vec incoming = load_upto(grad_y + j, lanes), factor = load_upto(scale + j, lanes);
            vec product = incoming * ((load_upto(activated + j, lanes) - mean) * inverse_deviation);
            sum += incoming * factor;
            sum_product += product * factor;
            add_to(grad_scale + j, product, lanes);
            add_to(grad_shift + j, incoming, lanes);
        });
        means[2 * row] = sum_of(sum) / (float)O;
        means[2 * row + 1] = sum_of(sum_product) / (float)O;
    }
}

/* One row's gradient before the activation, added to that of the bias unless this is NULL. No LayerNorm if scale is
 * NULL; then statistics and means are not read. */
INLINE void row_backward(long O, const int activation, const float *activated, const float *statistics,
                         const float *means, const float *scale, const float *grad_y, float *grad, float *grad_bias) {
    const vec mean = all(scale ? statistics[0] : 0), inverse_deviation = all(scale ? statistics[1] : 1);
    const vec mean_grad = all(scale ? means[0] : 0), mean_product = all(scale ? means[1] : 0);
    FOR_EACH_VECTOR(O, {
        vec g = load_upto(grad_y + j, lanes), a = load_upto(activated + j, lanes);
        if (scale) {
            vec normal = (a - mean) * inverse_deviation;
            g = (g * load_upto(scale + j, lanes) - mean_grad - normal * mean_product) * inverse_deviation;
        }
        g *= slope(a, activation);
        store_upto(grad + j, g, lanes);
        if (grad_bias)
            add_to(grad_bias + j, g, lanes);
    });
}

typedef struct {
    float *weight, *grad, *left, *right;
} LayerBackward;

static LayerBackward layer_backward_scratch(Arena *arena, long I, long O, int linear) {
    LayerBackward s = {0};
    s.grad = take(arena, BLOCK * O);
    if (linear) {
        s.weight = take(arena, packed_size(O, I));
        s.left = take(arena, left_size(O));
        s.right = take(arena, packed_size(DEPTH, I));
    }
    return s;
}

/* Gradients of what layer_forward computed, from that of y. Where it did not write `activated`, give x or y here. Those
 * of a part that is not there are NULL; grad_x may be NULL if nobody needs it. Returns 0, or 1 without memory. */
int layer_backward(long T, long I, long O, long activation, const float *x, const float *weight, const float *scale,
                   const float *activated, const float *statistics, const float *grad_y, float *grad_x,
                   float *grad_weight, float *grad_bias, float *grad_scale, float *grad_shift) {
    Arena arena = {0};
    layer_backward_scratch(&arena, I, O, weight != NULL);
    if (!begin_arena(&arena))
        return 1;
    LayerBackward s = layer_backward_scratch(&arena, I, O, weight != NULL);
    unsigned long mode = begin_flush();
    if (weight) {
        if (grad_x)
            pack(O, I, weight, I, s.weight, O);
        memset(grad_weight, 0, (size_t)(O * I) * sizeof(float));
    }
    if (grad_bias)
        memset(grad_bias, 0, (size_t)O * sizeof(float));
    if (scale) {
        memset(grad_scale, 0, (size_t)O * sizeof(float));
        memset(grad_shift, 0, (size_t)O * sizeof(float));
    }
    float means[2 * BLOCK];
    long filled = 0;
    for (long first = 0; first < T; first += BLOCK) {
        const long rows = min(BLOCK, T - first);
        const float *pairs = scale ? statistics + 2 * first : NULL;
        const float *from = activated + first * O, *incoming = grad_y + first * O;
        float *grad = weight ? s.grad : grad_x ? grad_x + first * O : NULL;
        if (scale)
            normalise_backward(rows, O, from, pairs, scale, incoming, grad_scale, grad_shift, means);
        for (long row = 0; row < rows && grad; row++) {
#define CALL(kind)                                                                                                     \
    row_backward(O, kind, from + row * O, pairs + 2 * row, means + 2 * row, scale, incoming + row * O,                 \
                 grad + row * O, grad_bias)
            FOR_ACTIVATION(activation, CALL)
#undef CALL
        }
        if (!weight)
            continue;
        if (grad_x)
            times_packed(rows, I, O, grad, O, s.weight, grad_x + first * I, I, 0);
        pack_left(rows, O, grad, O, s.left + filled * ROWS);
        pack(rows, I, x + first * I, I, s.right + filled * COLUMNS, DEPTH);
        filled += rows;
        if (filled + BLOCK > DEPTH || first + rows == T) {
            add_outer(O, I, filled, s.left, s.right, grad_weight);
            filled = 0;
        }
    }
    end_flush(mode);
    free(arena.base);
    return 0;
}

/* y[T, O] = LayerNorm(relu(table[code] + shared[row / N])), row by row.
 * table [K, O]. codes [T] in 0 .. K - 1, or NULL: code = row. shared [T / N, O]. scale, shift [O]. activated [T, O],
 * which may be y, and statistics [T, 2] or NULL are for looked_up_backward. Returns 0. */
int looked_up_forward(long T, long N, long O, const int64_t *codes, const float *table, const float *shared,
                      const float *scale, const float *shift, float *activated, float *statistics, float *y) {
    unsigned long mode = begin_flush();
    float own_statistics[2 * BLOCK];
    for (long first = 0; first < T; first += BLOCK) {
        const long end = min(first + BLOCK, T);
        float *pairs = statistics ? statistics + 2 * first : own_statistics;
        for (long row = first; row < end; row++)
            activate_row(O, RELU, table + (codes ? codes[row] : row) * O, shared + row / N * O, activated + row * O,
                         pairs + 2 * (row - first));
        normalise(end - first, O, activated + first * O, scale, shift, pairs, y + first * O);
    }
    end_flush(mode);
    return 0;
}

/* Gradients of what looked_up_forward computed, from that of y; grad_table [K, O]. Returns 0, or 1 without memory. */
int looked_up_backward(long T, long N, long O, long K, const int64_t *codes, const float *scale, const float *activated,
                       const float *statistics, const float *grad_y, float *grad_table, float *grad_shared,
                       float *grad_scale, float *grad_shift) {
    float *grad = malloc((size_t)O * sizeof(float));
    if (!grad)
        return 1;
    unsigned long mode = begin_flush();
    memset(grad_table, 0, (size_t)(K * O) * sizeof(float));
    memset(grad_shared, 0, (size_t)(T / N * O) * sizeof(float));
    memset(grad_scale, 0, (size_t)O * sizeof(float));
    memset(grad_shift, 0, (size_t)O * sizeof(float));
    float means[2 * BLOCK];
    for (long first = 0; first < T; first += BLOCK) {
        const long end = min(first + BLOCK, T);
        normalise_backward(end - first, O, activated + first * O, statistics + 2 * first, scale, grad_y + first * O,
                           grad_scale, grad_shift, means);
        for (long row = first; row < end; row++) {
            float *to = grad_table + (codes ? codes[row] : row) * O;
            row_backward(O, RELU, activated + row * O, statistics + 2 * row, means + 2 * (row - first), scale,
                         grad_y + row * O, grad, grad_shared + row / N * O);
            FOR_EACH_VECTOR(O, { add_to(to + j, load_upto(grad + j, lanes), lanes); });
        }
    }
    end_flush(mode);
    free(grad);
    return 0;
}
