/* The learner's networks on one core: what they give for a batch of sequences, and the gradient of a loss of it; and the
 * policy for the robots that act.
 *
 * Plain C with the vector extensions of GCC and clang. All matrices are row-major float32 and may lie at any address.
 * A result's bits depend on the numbers that went in alone: every sum runs in one fixed order, whatever the alignment,
 * the row's place in a block or the thread.
 *
 * A batch goes through its network in blocks of a few columns, forward, loss and backward, so that what the backward
 * pass needs of the forward pass is still in the cache. Past the last GRU and fan-out a row is on its own: these steps
 * take a block in parts of a few rows.
 *
 * Products run on register tiles of ROWS x COLUMNS. Their right operand is packed into panels of COLUMNS columns,
 * zero-padded, once per call or, for a policy, once and for all; a panel's block of DEPTH rows stays in the first-level
 * cache while the rows pass by it.
 */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__GLIBC__)
#include <malloc.h>
#endif
#if defined(__SSE__)
#include <immintrin.h>
#endif

#ifndef LANES
#if defined(__AVX512F__)
#define LANES 16
#else
#define LANES 8
#endif
#endif

enum { ROWS = 6, COLUMNS = 2 * LANES, DEPTH = 4096 / COLUMNS, BLOCK = 48, PART = 2 * BLOCK };
enum { IDENTITY = 0, RELU = 1, TANH = 2 };

typedef float vec __attribute__((vector_size(LANES * 4)));
typedef int32_t ivec __attribute__((vector_size(LANES * 4)));
typedef float unaligned_vec __attribute__((vector_size(LANES * 4), aligned(4), may_alias));

#define INLINE static inline __attribute__((always_inline))

INLINE vec load(const float *p) { return *(const unaligned_vec *)p; }

INLINE void store(float *p, vec v) { *(unaligned_vec *)p = v; }

INLINE vec all(float x) { return x - (vec){0}; }

/* The first n floats at p, then zeros; n may exceed LANES. */
INLINE vec load_upto(const float *p, long n) {
    if (n >= LANES)
        return load(p);
#if defined(__AVX512F__) && LANES == 16
    return _mm512_maskz_loadu_ps((__mmask16)((1u << n) - 1), p);
#elif defined(__AVX2__) && LANES == 8
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

INLINE float sum_of(vec v) {
#if LANES == 16
#define PAIR(i) (v[i] + v[i + 8])
#else
#define PAIR(i) v[i]
#endif
    return ((PAIR(0) + PAIR(4)) + (PAIR(2) + PAIR(6))) + ((PAIR(1) + PAIR(5)) + (PAIR(3) + PAIR(7)));
#undef PAIR
}

INLINE vec choose(ivec condition, vec yes, vec no) {
    return (vec)((condition & (ivec)yes) | (~condition & (ivec)no));
}

/* A NaN stays one. */
INLINE vec clamp(vec x, float limit) {
#if defined(__AVX512F__) && LANES == 16
    return _mm512_max_ps(all(-limit), _mm512_min_ps(all(limit), x));
#elif defined(__AVX__) && LANES == 8
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

/* To 1e-7 relative, by the Chebyshev polynomial of degree 5; x is held within -limit .. limit, at most 87. */
INLINE vec exp_of(vec x, float limit) {
    ivec power;
    vec f = reduce(clamp(x, limit), &power);
    vec e = f * all(0.008296807f) + all(0.04194099f);
    e = e * f + all(0.16667749f);
    e = e * f + all(0.4999862f);
    e = e * f + all(0.9999996f);
    e = e * f + all(1.0000001f);
    return (vec)((ivec)e + power);
}

/* x and y to their sigmoids, with one division; exact to 1e-18 where it is smaller. */
INLINE void two_sigmoids(vec *x, vec *y) {
    vec a = all(1) + exp_of(-*x, 43), b = all(1) + exp_of(-*y, 43), inverse = all(1) / (a * b);
    *x = inverse * b;
    *y = inverse * a;
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

static long max(long a, long b) { return a > b ? a : b; }

static long round_up(long n, long multiple) { return (n + multiple - 1) / multiple * multiple; }

#if defined(__SANITIZE_ADDRESS__) /* the tests have it watch the ends of the pieces, too */
#include <sanitizer/asan_interface.h>
enum { GAP = 64 };
#else
enum { GAP = 0 };
#endif

/* One allocation per call, handed out piece by piece; a first round adds up what the pieces need. */
typedef struct {
    char *base;
    size_t used;
} Arena;

static float *take(Arena *arena, long floats) {
    float *piece = arena->base ? (float *)(arena->base + arena->used) : NULL;
    const size_t used = arena->used + (size_t)floats * 4;
    arena->used = (size_t)round_up((long)used + GAP, 64);
#if defined(__SANITIZE_ADDRESS__)
    if (piece)
        ASAN_POISON_MEMORY_REGION(arena->base + used, arena->used - used);
#endif
    return piece;
}

static void *take_bytes(Arena *arena, long bytes) { return take(arena, (bytes + 3) / 4); }

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

/* Networks. */

enum { LAYER = 0, GRU = 1, FAN_OUT = 2 };
enum { MOST_STEPS = 16 };

/* What a network does one after another:
 *   LAYER    y = LayerNorm(activation(x weight^T + bias)); parameters weight [O, I], bias [O], scale and shift [O] of the
 *            LayerNorm, of which each pair may be NULL, and the bias.
 *   GRU      y = the states after each step; parameters weight_ih [3 O, I], weight_hh [3 O, O], bias_ih and bias_hh
 *            [3 O] in the order reset, update, candidate.
 *   FAN_OUT  y = LayerNorm(relu(table[code] + x)), a row per agent from a row per column; scale and shift in places 2, 3.
 * To `gradients`, of the parameters' shapes, what a batch contributes is added. */
typedef struct {
    long kind, activation, inputs, outputs;
    const float *parameters[4];
    float *gradients[4];
} Step;

/* An array [L, C, ...] whose steps and columns lie anywhere: how many [...] apart the ones and the others are. */
typedef struct {
    const void *data;
    long step, column;
} Array;

/* L steps of C columns, which are worlds or pieces of their history, of N agents each. */
typedef struct {
    long length, columns, agents;
    long rows;            /* of a column where the network begins: N, or 1 for the team as a whole */
    Array inputs;         /* [L, C, rows, inputs of the first step] */
    Array start;          /* [L, C] bytes; the state is zeroed before steps where this is not 0 */
    Array codes;          /* [L, C, N] int64 rows of the table; NULL: a row after another, K = L C N */
    const float *initial; /* [C, rows at the GRU, H] state before the first step */
    const float *table;   /* [K, O] what FAN_OUT adds */
} Batch;

/* One step at work on a block, or a part of one, of `rows` rows per column and `count` rows in all. */
typedef struct {
    long rows, count;
    float *forward, *backward, *backward_state;        /* packed weights */
    float *y, *activated, *statistics, *gates;         /* what the backward pass reads; [count, ...] */
} Work;

/* Scratch space for one block at a time of all steps. */
typedef struct {
    float *products;                               /* reset, update, candidate from the input, candidate from the
                                                      state: [4, BLOCK, COLUMNS] */
    float *before, *carried, *gate_gradients;      /* [BLOCK, H] twice, [BLOCK, 4 H] */
    float *candidate, *middle, *state, *left;      /* left factors of outer products: [H], [2 H], [H] and O columns */
    float *right, *right_state;                    /* their right factors */
    float *bias;                                   /* [4 H] */
    float *layer_gradient;                         /* [BLOCK, O] */
    float *from_above, *to_below;                  /* gradients between steps, */
    float *from_part, *to_part;                    /* and between those that take parts */
    float *inputs;
    uint8_t *start;
    int64_t *codes, *actions;
    float *of_loss[2], *weights;
    uint8_t *available;
} Scratch;

/* GRU. */

/* The state before a step: that after the step before, or zero where an episode starts. */
static void state_before(long rows, long H, const float *states, const uint8_t *start, float *before) {
    for (long row = 0; row < rows; row++)
        if (start[row])
            memset(before + row * H, 0, (size_t)H * sizeof(float));
        else
            memcpy(before + row * H, states + row * H, (size_t)H * sizeof(float));
}

/* What the backward pass needs of a row of a panel: candidate, reset, update, candidate from the state. */
enum { GATES = 4 * COLUMNS };

/* Gates, candidate and new state of a panel of at most COLUMNS units; products as in Scratch. In two passes, so that
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
            vec reset = load(products + at) + reset_bias, update = load(update_products + at) + update_bias;
            two_sigmoids(&reset, &update);
            store(products + at, reset);
            store(update_products + at, update);
        }
        for (long row = 0; row < rows; row++) {
            const long at = row * COLUMNS + j;
            vec reset = load(products + at), update = load(update_products + at);
            vec from_state = load(from_states + at) + state_bias;
            vec candidate = tanh_of(load(from_inputs + at) + input_bias + reset * from_state);
            vec old = load_upto(before + row * H + j, lanes);
            store_upto(states + row * H + j, candidate + update * (old - candidate), lanes);
            if (gates) {
                float *saved = gates + row * GATES + j;
                store(saved, candidate);
                store(saved + COLUMNS, reset);
                store(saved + 2 * COLUMNS, update);
                store(saved + 3 * COLUMNS, from_state);
            }
        }
    });
}

static void pack_gru(const Step *step, float *packed) {
    const long I = step->inputs, H = step->outputs, panel = (I + H) * COLUMNS;
    for (long column = 0; column < H; column += COLUMNS)
        for (long gate = 0; gate < 3; gate++, packed += panel) {
            const long columns = min(COLUMNS, H - column), first = gate * H + column;
            pack_transposed_panel(I, columns, step->parameters[0] + first * I, I, packed);
            pack_transposed_panel(H, columns, step->parameters[1] + first * H, H, packed + I * COLUMNS);
        }
}

/* States [L, R, H] after each step, and for the backward pass the gates, panel by panel.
 * inputs [L, R, I], initial [R, H], start [L, R]. */
static void gru_forward(long L, long R, const Step *step, const Work *work, const float *inputs, const float *initial,
                        const Scratch *s) {
    const long I = step->inputs, H = step->outputs, panel = (I + H) * COLUMNS;
    const float *bias_ih = step->parameters[2], *bias_hh = step->parameters[3];
    float *states = work->y, *gates = work->gates;
    for (long first = 0; first < R; first += BLOCK) {
        const long rows = min(BLOCK, R - first);
        for (long t = 0; t < L; t++) {
            const long at = t * R + first;
            const float *x = inputs + at * I;
            state_before(rows, H, t ? states + (at - R) * H : initial + first * H, s->start + at, s->before);
            const float *weights = work->forward;
            for (long column = 0; column < H; column += COLUMNS) {
                for (long gate = 0; gate < 3; gate++, weights += panel) {
                    float *from_input = s->products + gate * BLOCK * COLUMNS;
                    float *from_state = gate < 2 ? from_input : from_input + BLOCK * COLUMNS;
                    times_panel(rows, I, x, I, weights, from_input, COLUMNS, 0);
                    times_panel(rows, H, s->before, H, weights + I * COLUMNS, from_state, COLUMNS, gate < 2);
                }
                gates_panel(rows, min(COLUMNS, H - column), H, s->products, s->before + column, bias_ih + column,
                            bias_hh + column, states + at * H + column,
                            gates ? gates + 4 * at * round_up(H, COLUMNS) + rows * 4 * column : NULL);
            }
        }
    }
}

static void pack_gru_backward(const Step *step, Work *work, int to_inputs) {
    const long I = step->inputs, H = step->outputs;
    for (long column = 0; column < I && to_inputs; column += COLUMNS) {
        float *panel = work->backward + 3 * H * column;
        const long columns = min(COLUMNS, I - column);
        pack(H, columns, step->parameters[0] + 2 * H * I + column, I, panel, H); /* the candidate's rows come first */
        pack(2 * H, columns, step->parameters[0] + column, I, panel + H * COLUMNS, 2 * H);
    }
    pack(3 * H, H, step->parameters[1], H, work->backward_state, 3 * H);
}

/* Gradients before the gates [rows, 4 H], candidate, reset, update, candidate from the state, added to `bias` [4 H]; what
 * passes by the gates to the state before is left in `carried`. */
static void gates_panels_backward(long rows, long H, const float *gates, const float *before, const float *incoming,
                                  float *carried, float *gradients, float *bias) {
    for (long column = 0; column < H; column += COLUMNS, gates += rows * GATES)
        FOR_EACH_VECTOR(min(COLUMNS, H - column), {
            vec candidates = all(0), resets = all(0), updates = all(0), from_states = all(0);
            const long first = column + j;
            for (long row = 0; row < rows; row++) {
                const float *saved = gates + row * GATES + j;
                const long at = row * H + first;
                vec candidate = load(saved), reset = load(saved + COLUMNS), update = load(saved + 2 * COLUMNS);
                vec grad = load_upto(carried + at, lanes) + load_upto(incoming + at, lanes);
                vec kept = grad * update;
                vec to_candidate = (grad - kept) * (all(1) - candidate * candidate);
                vec to_state = to_candidate * reset;
                vec to_reset = to_state * load(saved + 3 * COLUMNS) * (all(1) - reset);
                vec to_update = kept * (load_upto(before + at, lanes) - candidate) * (all(1) - update);
                float *out = gradients + row * 4 * H + first;
                store_upto(carried + at, kept, lanes);
                store_upto(out, to_candidate, lanes);
                store_upto(out + H, to_reset, lanes);
                store_upto(out + 2 * H, to_update, lanes);
                store_upto(out + 3 * H, to_state, lanes);
                candidates += to_candidate;
                resets += to_reset;
                updates += to_update;
                from_states += to_state;
            }
            add_to(bias + first, candidates, lanes);
            add_to(bias + H + first, resets, lanes);
            add_to(bias + 2 * H + first, updates, lanes);
            add_to(bias + 3 * H + first, from_states, lanes);
        });
}

/* Gradients of what gru_forward computed, from those of its states [L, R, H]; grad_inputs may be NULL. */
static void gru_backward(long L, long R, const Step *step, const Work *work, const float *inputs, const float *initial,
                         const float *grad_states, float *grad_inputs, const Scratch *s) {
    const long I = step->inputs, H = step->outputs;
    memset(s->bias, 0, (size_t)(4 * H) * sizeof(float));
    long filled = 0;
    for (long first = 0; first < R; first += BLOCK) {
        const long rows = min(BLOCK, R - first);
        memset(s->carried, 0, (size_t)(rows * H) * sizeof(float));
        for (long t = L - 1; t >= 0; t--) {
            const long at = t * R + first;
            state_before(rows, H, t ? work->y + (at - R) * H : initial + first * H, s->start + at, s->before);
            gates_panels_backward(rows, H, work->gates + 4 * at * round_up(H, COLUMNS), s->before, grad_states + at * H,
                                  s->carried, s->gate_gradients, s->bias);
            if (grad_inputs)
                times_packed(rows, I, 3 * H, s->gate_gradients, 4 * H, work->backward, grad_inputs + at * I, I, 0);
            if (t)
                times_packed(rows, H, 3 * H, s->gate_gradients + H, 4 * H, work->backward_state, s->carried, H, 1);
            for (long row = 0; row < rows; row++)
                if (s->start[at + row])
                    memset(s->carried + row * H, 0, (size_t)H * sizeof(float));
            pack_left(rows, H, s->gate_gradients, 4 * H, s->candidate + filled * ROWS);
            pack_left(rows, 2 * H, s->gate_gradients + H, 4 * H, s->middle + filled * ROWS);
            pack_left(rows, H, s->gate_gradients + 3 * H, 4 * H, s->state + filled * ROWS);
            pack(rows, I, inputs + at * I, I, s->right + filled * COLUMNS, DEPTH);
            pack(rows, H, s->before, H, s->right_state + filled * COLUMNS, DEPTH);
            filled += rows;
            const long next = t ? rows : min(BLOCK, R - first - rows);
            if (filled + next > DEPTH || next <= 0) {
                float *to_ih = step->gradients[0], *to_hh = step->gradients[1];
                add_outer(2 * H, I, filled, s->middle, s->right, to_ih);
                add_outer(H, I, filled, s->candidate, s->right, to_ih + 2 * H * I);
                add_outer(2 * H, H, filled, s->middle, s->right_state, to_hh);
                add_outer(H, H, filled, s->state, s->right_state, to_hh + 2 * H * H);
                filled = 0;
            }
        }
    }
    for (long j = 0; j < H; j++) {
        step->gradients[2][j] += s->bias[H + j];
        step->gradients[2][H + j] += s->bias[2 * H + j];
        step->gradients[2][2 * H + j] += s->bias[j];
        step->gradients[3][j] += s->bias[H + j];
        step->gradients[3][H + j] += s->bias[2 * H + j];
        step->gradients[3][2 * H + j] += s->bias[3 * H + j];
    }
}

/* [linear, activation, LayerNorm], and the fan-out. */

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

/* Whether what a LAYER normalises is neither its input nor its output, so that it is kept apart. */
static int keeps_activated(const Step *step) {
    return step->parameters[2] && (step->parameters[0] || step->activation != IDENTITY);
}

static void layer_forward(const Step *step, const Work *work, const float *x) {
    const float *weight = step->parameters[0], *bias = step->parameters[1], *scale = step->parameters[2];
    const long I = step->inputs, O = step->outputs;
    const int only_norm = scale && !keeps_activated(step);
    for (long first = 0; first < work->count; first += BLOCK) {
        const long rows = min(BLOCK, work->count - first);
        float *y = work->y + first * O, *middle = keeps_activated(step) ? work->activated + first * O : y;
        float *statistics = work->statistics + 2 * first;
        if (weight)
            times_packed(rows, O, I, x + first * I, I, work->forward, middle, O, 0);
        const float *from = weight ? middle : x + first * O;
        for (long row = 0; row < rows; row++) {
#define CALL(kind)                                                                                                     \
    activate_row(O, kind, from + row * O, bias, only_norm ? NULL : middle + row * O, statistics + 2 * row)
            FOR_ACTIVATION(step->activation, CALL)
#undef CALL
        }
        if (scale)
            normalise(rows, O, only_norm ? from : middle, scale, step->parameters[3], statistics, y);
    }
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

/* Gradients of what layer_forward computed, from that of y [count, O]; grad_x may be NULL if nobody needs it. */
static void layer_backward(const Step *step, const Work *work, const float *x, const float *grad_y, float *grad_x,
                           const Scratch *s) {
    const float *weight = step->parameters[0], *scale = step->parameters[2];
    const long I = step->inputs, O = step->outputs;
    const float *activated = keeps_activated(step) ? work->activated : scale ? x : work->y;
    float means[2 * BLOCK];
    long filled = 0;
    for (long first = 0; first < work->count; first += BLOCK) {
        const long rows = min(BLOCK, work->count - first);
        const float *from = activated + first * O, *incoming = grad_y + first * O;
        const float *statistics = work->statistics + 2 * first;
        float *grad = weight ? s->layer_gradient : grad_x ? grad_x + first * O : NULL;
        if (scale)
            normalise_backward(rows, O, from, statistics, scale, incoming, step->gradients[2], step->gradients[3], means);
        for (long row = 0; row < rows && grad; row++) {
#define CALL(kind)                                                                                                     \
    row_backward(O, kind, from + row * O, statistics + 2 * row, means + 2 * row, scale, incoming + row * O,            \
                 grad + row * O, step->gradients[1])
            FOR_ACTIVATION(step->activation, CALL)
#undef CALL
        }
        if (!weight)
            continue;
        if (grad_x)
            times_packed(rows, I, O, grad, O, work->backward, grad_x + first * I, I, 0);
        pack_left(rows, O, grad, O, s->left + filled * ROWS);
        pack(rows, I, x + first * I, I, s->right + filled * COLUMNS, DEPTH);
        filled += rows;
        if (filled + BLOCK > DEPTH || first + rows == work->count) {
            add_outer(O, I, filled, s->left, s->right, step->gradients[0]);
            filled = 0;
        }
    }
}

/* Rows of a table lie anywhere in it: the processor is told of each AHEAD rows before it is used. */
enum { AHEAD = 4 };

INLINE void prefetch_row(const float *row, long O) {
    for (long j = 0; j < O; j += 16)
        __builtin_prefetch(row + j);
}

/* y[row] = LayerNorm(relu(table[code of row] + x[row / N])). */
static void fan_out_forward(const Step *step, const Work *work, long N, const float *table, const int64_t *codes,
                            const float *x) {
    const long O = step->outputs;
    for (long first = 0; first < work->count; first += BLOCK) {
        const long end = min(first + BLOCK, work->count);
        for (long row = first; row < end; row++) {
            if (row + AHEAD < work->count)
                prefetch_row(table + codes[row + AHEAD] * O, O);
            activate_row(O, RELU, table + codes[row] * O, x + row / N * O, work->activated + row * O,
                         work->statistics + 2 * row);
        }
        normalise(end - first, O, work->activated + first * O, step->parameters[2], step->parameters[3],
                  work->statistics + 2 * first, work->y + first * O);
    }
}

/* grad_x may be NULL if nobody needs it. */
static void fan_out_backward(const Step *step, const Work *work, long N, const float *grad_y, float *grad_table,
                             const int64_t *codes, float *grad_x, const Scratch *s) {
    const long O = step->outputs;
    const float *scale = step->parameters[2];
    if (grad_x)
        memset(grad_x, 0, (size_t)(work->count / N * O) * sizeof(float));
    float means[2 * BLOCK];
    for (long first = 0; first < work->count; first += BLOCK) {
        const long end = min(first + BLOCK, work->count);
        normalise_backward(end - first, O, work->activated + first * O, work->statistics + 2 * first, scale,
                           grad_y + first * O, step->gradients[2], step->gradients[3], means);
        for (long row = first; row < end; row++) {
            float *to = grad_table + codes[row] * O, *grad = s->layer_gradient;
            if (row + AHEAD < work->count)
                prefetch_row(grad_table + codes[row + AHEAD] * O, O);
            row_backward(O, RELU, work->activated + row * O, work->statistics + 2 * row, means + 2 * (row - first), scale,
                         grad_y + row * O, grad, grad_x ? grad_x + row / N * O : NULL);
            FOR_EACH_VECTOR(O, { add_to(to + j, load_upto(grad + j, lanes), lanes); });
        }
    }
}

/* Of those that are `available`, which NULL says of all. */
static float largest_of(long n, const float *x, const uint8_t *available) {
    float largest = -INFINITY;
    for (long i = 0; i < n; i++)
        if (!available || available[i])
            largest = x[i] > largest ? x[i] : largest;
    return largest;
}

static void zero_unavailable(long n, float *x, const uint8_t *available) {
    if (available)
        for (long i = 0; i < n; i++)
            x[i] = available[i] ? x[i] : 0;
}

/* Losses: sums over weighted rows, each with its gradient. */

enum { POLICY = 0, VALUE = 1, REWARD = 2, JOINT_REWARD = 3 };

typedef struct {
    long kind;
    double numbers[3];
    Array actions; /* [L, C, N] int64; not for VALUE */
    Array data[2]; /* POLICY: old log-probabilities, advantages [L, C, N]. VALUE: old values, targets [L, C, N].
                      REWARD and JOINT_REWARD: rewards [L, C] */
    Array weights; /* [L, C, N] */
    Array available; /* POLICY: [L, C, N, A] bytes, 0 where an action cannot be chosen; NULL: all can */
} Loss;

/* Whether a target is the team's, not an agent's. */
static int is_of_team(const Loss *loss) { return loss->kind == REWARD || loss->kind == JOINT_REWARD; }

/* -surrogate (eq. 4) - bonus * entropy, on T rows of A logits; numbers: clip, bonus.
 * To sums [4] is added: the negated surrogate, the entropy, the fraction of clipped ratios, -log ratio. */
static void policy_loss(long T, long A, const Loss *loss, const float *logits, float *grad, double *sums,
                        const Scratch *s) {
    const float clip = (float)loss->numbers[0], bonus = (float)loss->numbers[1];
    double surrogates = 0, entropies = 0, clipped = 0, divergences = 0;
    for (long row = 0; row < T; row++, logits += A, grad += A) {
        const uint8_t *available = s->available ? s->available + row * A : NULL;
        const float largest = largest_of(A, logits, available);
        vec total = all(0), expected = all(0);
        FOR_EACH_VECTOR(A, { store_upto(grad + j, exp_of(load_upto(logits + j, lanes) - all(largest), 87), lanes); });
        zero_unavailable(A, grad, available);
        FOR_EACH_VECTOR(A, {
            vec e = load_upto(grad + j, lanes); /* nothing beyond the last action */
            total += e;
            expected += e * (load_upto(logits + j, lanes) - all(largest));
        });
        const float sum = sum_of(total), log_sum = logf(sum), entropy = log_sum - sum_of(expected) / sum;
        const long action = s->actions[row];
        const float log_ratio = logits[action] - largest - log_sum - s->of_loss[0][row], ratio = expf(log_ratio);
        const float advantage = s->of_loss[1][row], weight = s->weights[row];
        const float free = ratio * advantage, held = fminf(fmaxf(ratio, 1 - clip), 1 + clip) * advantage;
        const int clipped_away = held < free; /* not within the clip range, where the two are one, nor for a NaN */
        const float push = clipped_away ? 0 : free;
        const vec factor = all(weight / sum), above = all(entropy - log_sum);
        FOR_EACH_VECTOR(A, {
            vec slope = all(push) + all(bonus) * (load_upto(logits + j, lanes) - all(largest) + above);
            store_upto(grad + j, load_upto(grad + j, lanes) * factor * slope, lanes);
        });
        grad[action] -= push * weight;
        surrogates -= (double)((clipped_away ? held : free) * weight);
        entropies += (double)(entropy * weight);
        clipped += fabsf(ratio - 1) > clip ? (double)weight : 0;
        divergences -= (double)(log_ratio * weight);
    }
    sums[0] += surrogates;
    sums[1] += entropies;
    sums[2] += clipped;
    sums[3] += divergences;
}

INLINE float huber(float error, float delta) {
    const float size = fabsf(error);
    return size <= delta ? error * error / 2 : delta * (size - delta / 2);
}

/* The clipped value loss (eq. 40) with Huber errors on T values; numbers: clip, delta, and what the gradient is
 * multiplied with. sums [1]. */
static void value_loss(long T, const Loss *loss, const float *values, float *grad, double *sums, const Scratch *s) {
    const float clip = (float)loss->numbers[0], delta = (float)loss->numbers[1], coefficient = (float)loss->numbers[2];
    for (long row = 0; row < T; row++) {
        const float old = s->of_loss[0][row], target = s->of_loss[1][row], weight = s->weights[row];
        const float moved = values[row] - old, held_move = moved > clip ? clip : moved < -clip ? -clip : moved;
        const float free = values[row] - target;
        const float held = held_move == moved ? free : old + held_move - target; /* or rounding could tell the two apart */
        const float of_free = huber(free, delta), of_held = huber(held, delta);
        const int moves = of_free >= of_held;
        const float slope = moves ? (free > delta ? delta : free < -delta ? -delta : free) : 0 * of_held; /* NaN if that is */
        sums[0] += (double)((moves ? of_free : of_held) * weight);
        grad[row] = slope * weight * coefficient;
    }
}

/* Half the squared error of the predicted reward of the action taken (eq. 19), on T rows of A predictions. sums [1]. */
static void reward_loss(long T, long N, long A, const float *predicted, float *grad, double *sums, const Scratch *s) {
    memset(grad, 0, (size_t)(T * A) * sizeof(float));
    for (long row = 0; row < T; row++) {
        const long at = row * A + s->actions[row];
        const float error = predicted[at] - s->of_loss[0][row / N], weight = s->weights[row];
        sums[0] += (double)(error * error * weight) / 2;
        grad[at] = error * weight;
    }
}

/* The same of a reward predicted once for the team, on T rows of N A (1 + R) outputs; numbers: R, the rewards' mean and
 * deviation, from which and in whose units it is predicted. For each action of each agent the outputs are what it adds by
 * itself, and a vector [R]: the product of two agents' vectors, over N^2, is what their actions add together. sums [1]. */
static void joint_reward_loss(long T, long N, long O, const Loss *loss, const float *outputs, float *grad, double *sums,
                              const Scratch *s) {
    const long width = 1 + (long)loss->numbers[0], of_agent = O / N;
    const float mean = (float)loss->numbers[1], deviation = (float)loss->numbers[2], of_pair = 1 / (float)(N * N);
    memset(grad, 0, (size_t)(T * O) * sizeof(float));
    for (long row = 0; row < T; row++, outputs += O, grad += O) {
        const int64_t *actions = s->actions + row * N;
        float predicted = 0, weight = 0;
        for (long agent = 0; agent < N; agent++) {
            const long at = agent * of_agent + actions[agent] * width;
            predicted += outputs[at];
            grad[at] = 1;
            weight += s->weights[row * N + agent];
        }
        for (long k = 1; k < width; k++) {
            float sum = 0, squares = 0;
            for (long agent = 0; agent < N; agent++) {
                const float x = outputs[agent * of_agent + actions[agent] * width + k];
                sum += x;
                squares += x * x;
            }
            predicted += (sum * sum - squares) / 2 * of_pair;
            for (long agent = 0; agent < N; agent++) {
                const long at = agent * of_agent + actions[agent] * width + k;
                grad[at] = (sum - outputs[at]) * of_pair;
            }
        }
        const float error = predicted - (s->of_loss[0][row] - mean) / deviation;
        sums[0] += (double)(error * error * deviation * deviation * weight) / 2;
        for (long agent = 0; agent < N; agent++)
            for (long k = 0; k < width; k++)
                grad[agent * of_agent + actions[agent] * width + k] *= error * weight;
    }
}

/* The whole network. */

static long rows_at_end(const Step *steps, long count, const Batch *batch) {
    for (long i = 0; i < count; i++)
        if (steps[i].kind == FAN_OUT)
            return batch->agents;
    return batch->rows;
}

static long rows_at_gru(const Step *steps, long count, const Batch *batch) {
    long rows = batch->rows;
    for (long i = 0; i < count; i++) {
        if (steps[i].kind == GRU)
            return rows;
        rows = steps[i].kind == FAN_OUT ? batch->agents : rows;
    }
    return rows;
}

/* The first step of those that take a block in parts. */
static long first_in_parts(const Step *steps, long count) {
    long first = 0;
    for (long i = 0; i < count; i++)
        first = steps[i].kind == GRU ? i + 1 : steps[i].kind == FAN_OUT ? i : first;
    return first;
}

/* How many of a block's `length` steps of columns a part has. */
static long part_size(const Step *steps, long count, const Batch *batch, long length) {
    return max(1, min(length, PART / rows_at_end(steps, count, batch)));
}

/* Hands out the memory of the packed weights; those of the backward pass only if the network `learns`. */
static void plan_weights(Arena *arena, const Step *steps, long count, int learns, Work *works) {
    for (long i = 0; i < count; i++) {
        const long I = steps[i].inputs, O = steps[i].outputs;
        Work *work = works + i;
        if (steps[i].kind == GRU) {
            work->forward = take(arena, 3 * packed_size(I + O, O));
            work->backward = learns ? take(arena, packed_size(3 * O, I)) : NULL;
            work->backward_state = learns ? take(arena, packed_size(3 * O, O)) : NULL;
        } else if (steps[i].kind == LAYER && steps[i].parameters[0]) {
            work->forward = take(arena, packed_size(I, O));
            work->backward = learns ? take(arena, packed_size(O, I)) : NULL;
        }
    }
}

static void pack_weights(const Step *steps, long count, int learns, Work *works) {
    for (long i = 0; i < count; i++) {
        const Step *step = steps + i;
        if (step->kind == GRU) {
            pack_gru(step, works[i].forward);
            if (learns)
                pack_gru_backward(step, works + i, i > 0);
        } else if (step->kind == LAYER && step->parameters[0]) {
            pack_transposed(step->inputs, step->outputs, step->parameters[0], works[i].forward);
            if (learns && i > 0)
                pack(step->outputs, step->inputs, step->parameters[0], step->inputs, works[i].backward, step->outputs);
        }
    }
}

/* Hands out the rest of the memory for blocks of `columns` columns; without `loss`, what a forward pass needs. */
static Scratch plan(Arena *arena, const Step *steps, long count, const Batch *batch, const Loss *loss, long columns,
                    Work *works) {
    Scratch s = {0};
    const long length = batch->length * columns, all_rows = length * batch->agents;
    const long in_parts = first_in_parts(steps, count), part = part_size(steps, count, batch, length);
    long rows = batch->rows, widest = 1, widest_part = 1, inputs = 1, outputs = 1, units = 1;
    for (long i = 0; i < count; i++) {
        const Step *step = steps + i;
        const long I = step->inputs, O = step->outputs;
        rows = step->kind == FAN_OUT ? batch->agents : rows;
        Work *work = works + i;
        work->rows = rows;
        work->count = (i < in_parts ? length : part) * rows;
        work->y = take(arena, (i == count - 1 ? length * rows : work->count) * O);
        work->activated = keeps_activated(step) || step->kind == FAN_OUT ? take(arena, work->count * O) : NULL;
        work->statistics = take(arena, 2 * work->count);
        if (step->kind == GRU) {
            work->gates = loss ? take(arena, work->count * 4 * round_up(O, COLUMNS)) : NULL;
            units = max(units, O);
        }
        inputs = max(inputs, I);
        outputs = max(outputs, O);
        if (i < in_parts)
            widest = max(widest, work->count * max(O, i ? I : 0));
        else
            widest_part = max(widest_part, work->count * max(O, I));
    }
    s.inputs = take(arena, length * batch->rows * steps[0].inputs);
    s.products = take(arena, 4 * BLOCK * COLUMNS);
    s.before = take(arena, BLOCK * units);
    s.start = take_bytes(arena, all_rows);
    s.codes = take_bytes(arena, all_rows * (long)sizeof(int64_t));
    if (!loss)
        return s;
    s.carried = take(arena, BLOCK * units);
    s.gate_gradients = take(arena, BLOCK * 4 * units);
    s.candidate = take(arena, left_size(units));
    s.middle = take(arena, left_size(2 * units));
    s.state = take(arena, left_size(units));
    s.left = take(arena, left_size(outputs));
    s.right = take(arena, packed_size(DEPTH, inputs));
    s.right_state = take(arena, packed_size(DEPTH, units));
    s.bias = take(arena, 4 * units);
    s.layer_gradient = take(arena, BLOCK * outputs);
    s.from_above = take(arena, widest);
    s.to_below = take(arena, widest);
    s.from_part = take(arena, widest_part);
    s.to_part = take(arena, widest_part);
    s.actions = take_bytes(arena, all_rows * (long)sizeof(int64_t));
    s.of_loss[0] = take(arena, all_rows);
    s.of_loss[1] = take(arena, all_rows);
    s.weights = take(arena, all_rows);
    s.available = loss->available.data ? take_bytes(arena, all_rows * steps[count - 1].outputs) : NULL;
    return s;
}

/* Copies `columns` columns from `first` on, of `bytes` each step, to [L, columns, bytes]. */
static void gather(const Array *from, long L, long first, long columns, long bytes, void *to) {
    char *into = to;
    for (long t = 0; t < L; t++) {
        const char *source = (const char *)from->data + (t * from->step + first * from->column) * bytes;
        if (from->column == 1) {
            memcpy(into, source, (size_t)(columns * bytes));
            into += columns * bytes;
        } else {
            for (long column = 0; column < columns; column++, source += from->column * bytes, into += bytes)
                memcpy(into, source, (size_t)bytes);
        }
    }
}

/* The way back, to[L, C, bytes]. */
static void scatter(long L, long C, long first, long columns, long bytes, const void *from, void *to) {
    for (long t = 0; t < L; t++)
        memcpy((char *)to + (t * C + first) * bytes, (const char *)from + t * columns * bytes, (size_t)(columns * bytes));
}

/* A LAYER or a FAN_OUT. */
static void rows_forward(const Step *step, const Work *work, const Batch *batch, const float *x, const int64_t *codes) {
    if (step->kind == FAN_OUT)
        fan_out_forward(step, work, batch->agents, batch->table, codes, x);
    else
        layer_forward(step, work, x);
}

static void rows_backward(const Step *step, const Work *work, const Batch *batch, const float *x, const float *grad_y,
                          float *grad_table, float *grad_x, const Scratch *s) {
    if (step->kind == FAN_OUT)
        fan_out_backward(step, work, batch->agents, grad_y, grad_table, s->codes, grad_x, s);
    else
        layer_backward(step, work, x, grad_y, grad_x, s);
}

/* Gathers what belongs to a block of columns, of a network with so many `outputs`, and takes it through the first `count`
 * steps. */
static void forward_block(const Step *steps, long count, long outputs, const Batch *batch, const Loss *loss, long first,
                          long columns, Work *works, Scratch *s) {
    const long L = batch->length, C = batch->columns, N = batch->agents, size = (long)sizeof(float);
    gather(&batch->inputs, L, first, columns, batch->rows * steps[0].inputs * size, s->inputs);
    if (batch->codes.data)
        gather(&batch->codes, L, first, columns, N * (long)sizeof(int64_t), s->codes);
    else
        for (long t = 0, row = 0; t < L; t++)
            for (long at = (t * C + first) * N; at < (t * C + first + columns) * N; at++)
                s->codes[row++] = at;
    if (loss) {
        gather(&loss->weights, L, first, columns, N * size, s->weights);
        if (loss->available.data)
            gather(&loss->available, L, first, columns, N * outputs, s->available);
        for (int i = 0; i < 2; i++)
            if (loss->data[i].data)
                gather(&loss->data[i], L, first, columns, is_of_team(loss) ? size : N * size, s->of_loss[i]);
        if (loss->actions.data)
            gather(&loss->actions, L, first, columns, N * (long)sizeof(int64_t), s->actions);
    }
    const float *x = s->inputs;
    for (long i = 0; i < count; i++) {
        Work *work = works + i;
        work->count = L * columns * work->rows;
        if (steps[i].kind == GRU) {
            const uint8_t *flags = batch->start.data;
            uint8_t *start = s->start;
            for (long t = 0; t < L; t++)
                for (long column = first; column < first + columns; column++, start += work->rows)
                    memset(start, flags[t * batch->start.step + column * batch->start.column], (size_t)work->rows);
            gru_forward(L, columns * work->rows, steps + i, work, x,
                        batch->initial + first * work->rows * steps[i].outputs, s);
        } else {
            rows_forward(steps + i, work, batch, x, s->codes);
        }
        x = work->y;
    }
}

/* The steps from `from` on, forward and with `loss` backward, for `size` of a block's steps of columns from number `at`
 * on. */
static void run_part(const Step *steps, long from, long count, const Batch *batch, const Loss *loss, long at, long size,
                     const Work *works, float *grad_table, double *sums, const Scratch *of_block) {
    const long N = batch->agents, last = count - 1, per_step = loss && is_of_team(loss) ? 1 : N;
    Scratch s = *of_block;
    Work own[MOST_STEPS];
    memcpy(own, works, (size_t)count * sizeof(Work));
    own[last].y += at * own[last].rows * steps[last].outputs;
    s.codes += at * N;
    const float *inputs = s.inputs + at * batch->rows * steps[0].inputs;
    if (from)
        inputs = works[from - 1].y + at * works[from - 1].rows * steps[from - 1].outputs;
    for (long i = from; i < count; i++) {
        own[i].count = size * own[i].rows;
        rows_forward(steps + i, own + i, batch, i > from ? own[i - 1].y : inputs, s.codes);
    }
    if (!loss)
        return;
    float *below = from ? s.from_above + at * works[from - 1].rows * steps[from - 1].outputs : NULL;
    float *grad = from < count ? s.from_part : below;
    s.actions += at * N;
    s.of_loss[0] += at * per_step;
    s.of_loss[1] += at * per_step;
    s.weights += at * N;
    if (s.available)
        s.available += at * N * steps[last].outputs;
    const long rows = size * own[last].rows, outputs = steps[last].outputs;
    if (loss->kind == POLICY)
        policy_loss(rows, outputs, loss, own[last].y, grad, sums, &s);
    else if (loss->kind == VALUE)
        value_loss(rows, loss, own[last].y, grad, sums, &s);
    else if (loss->kind == REWARD)
        reward_loss(rows, N, outputs, own[last].y, grad, sums, &s);
    else
        joint_reward_loss(rows, N, outputs, loss, own[last].y, grad, sums, &s);
    for (long i = last; i >= from; i--) {
        rows_backward(steps + i, own + i, batch, i > from ? own[i - 1].y : inputs, s.from_part, grad_table,
                      i > from ? s.to_part : below, &s);
        float *free = s.from_part;
        s.from_part = s.to_part;
        s.to_part = free;
    }
}

/* The first `count` steps backward. */
static void backward_block(const Step *steps, long count, const Batch *batch, long first, long columns, float *grad_table,
                           const Work *works, const Scratch *of_block) {
    Scratch s = *of_block;
    for (long i = count - 1; i >= 0; i--) {
        const Work *work = works + i;
        const float *x = i ? works[i - 1].y : s.inputs;
        float *to_below = i ? s.to_below : NULL;
        if (steps[i].kind == GRU)
            gru_backward(batch->length, columns * work->rows, steps + i, work, x,
                         batch->initial + first * work->rows * steps[i].outputs, s.from_above, to_below, &s);
        else
            rows_backward(steps + i, work, batch, x, s.from_above, grad_table, to_below, &s);
        s.to_below = s.from_above;
        s.from_above = to_below;
    }
}

/* Forward passes over all columns, and with `loss` backward passes, too. `packed`: memory in which the weights lie packed
 * already, or NULL. Returns 0, or 1 if there is no memory. */
static int run(const Step *steps, long count, void *packed, const Batch *batch, const Loss *loss, float *outputs,
               float *states, float *grad_table, double *sums) {
    const long L = batch->length, C = batch->columns, size = (long)sizeof(float);
    const long block = max(1, min(C, BLOCK / rows_at_gru(steps, count, batch)));
    const long in_parts = first_in_parts(steps, count), part = part_size(steps, count, batch, L * block);
    const int learns = loss != NULL;
    Work works[MOST_STEPS] = {0};
    Arena arena = {0}, prepared = {packed, 0};
    plan_weights(packed ? &prepared : &arena, steps, count, learns, works);
    plan(&arena, steps, count, batch, loss, block, works);
    if (!begin_arena(&arena))
        return 1;
    if (!packed)
        plan_weights(&arena, steps, count, learns, works);
    Scratch s = plan(&arena, steps, count, batch, loss, block, works);
    const unsigned long mode = begin_flush();
    if (!packed)
        pack_weights(steps, count, learns, works);
    for (long first = 0; first < C; first += block) {
        const long columns = min(block, C - first);
        forward_block(steps, in_parts, steps[count - 1].outputs, batch, loss, first, columns, works, &s);
        for (long at = 0; at < L * columns; at += part)
            run_part(steps, in_parts, count, batch, loss, at, min(part, L * columns - at), works, grad_table, sums, &s);
        if (loss)
            backward_block(steps, in_parts, batch, first, columns, grad_table, works, &s);
        for (long i = 0; i < count; i++)
            if (steps[i].kind == GRU && states)
                scatter(L, C, first, columns, works[i].rows * steps[i].outputs * size, works[i].y, states);
        if (outputs)
            scatter(L, C, first, columns, works[count - 1].rows * steps[count - 1].outputs * size, works[count - 1].y, outputs);
    }
    end_flush(mode);
    free(arena.base);
    return 0;
}

/* outputs [L, C, rows at the end, outputs of the last step]; states [L, C, rows at the GRU, H] after each step. */
int network_forward(const Step *steps, long count, const Batch *batch, float *outputs, float *states) {
    return run(steps, count, NULL, batch, NULL, outputs, states, NULL, NULL);
}

/* Adds the gradients of the loss to those of the steps and to grad_table [K, O], and the loss's sums to `sums` [at most 4]. */
int network_gradient(const Step *steps, long count, const Batch *batch, const Loss *loss, float *grad_table,
                     double *sums) {
    return run(steps, count, NULL, batch, loss, NULL, NULL, grad_table, sums);
}

/* Acting. */

/* Each row of A scores to their exponentials over the sum of these, those of what is not `available` [rows, A] to zeros. */
static void softmax(long rows, long A, const uint8_t *available, float *scores) {
    for (long row = 0; row < rows; row++, scores += A) {
        const uint8_t *own = available ? available + row * A : NULL;
        const vec largest = all(largest_of(A, scores, own));
        vec total = all(0);
        FOR_EACH_VECTOR(A, { store_upto(scores + j, exp_of(load_upto(scores + j, lanes) - largest, 87), lanes); });
        zero_unavailable(A, scores, own);
        FOR_EACH_VECTOR(A, { total += load_upto(scores + j, lanes); }); /* nothing beyond the last action */
        const vec inverse = all(1 / sum_of(total));
        FOR_EACH_VECTOR(A, { store_upto(scores + j, load_upto(scores + j, lanes) * inverse, lanes); });
    }
}

static void *aligned(void *memory) { return (void *)(((uintptr_t)memory + 63) & ~(uintptr_t)63); }

/* Packs the weights of a policy, whose steps are layers and a GRU, into `memory` unless this is NULL. Returns how many
 * bytes that needs; 0 for more steps than a network may have. */
long policy_pack(const Step *steps, long count, void *memory) {
    if (count > MOST_STEPS)
        return 0;
    Work works[MOST_STEPS] = {0};
    Arena arena = {aligned(memory), 0};
    plan_weights(&arena, steps, count, 0, works);
    if (memory)
        pack_weights(steps, count, 0, works);
    return 63 + (long)arena.used;
}

/* Probabilities [W, A] of the actions and the next states [W, H], for observations [W, O], states [W, H], episode starts
 * [W] and the actions `available` [W, A], NULL for all, of W worlds; `packed` by policy_pack. A world's bits do not depend
 * on the others. */
int policy_act(const Step *steps, long count, void *packed, long worlds, const float *observations, const float *states,
               const uint8_t *episode_start, const uint8_t *available, float *probabilities, float *next_states) {
    const Batch batch = {.length = 1, .columns = worlds, .agents = 1, .rows = 1, .inputs = {observations, worlds, 1},
                         .start = {episode_start, worlds, 1}, .initial = states};
    if (run(steps, count, aligned(packed), &batch, NULL, probabilities, next_states, NULL, NULL))
        return 1;
    softmax(worlds, steps[count - 1].outputs, available, probabilities);
    return 0;
}
