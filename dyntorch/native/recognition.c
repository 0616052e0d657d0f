/* Recognition: robust lines through neighbouring sightings, and residuals of all pairs of windows, float32.

   Compiled as kernel.c is.  2 * LANES problems or pairs side by side in a register; what is computed, and in which words, is in
   indexing/windows.py (_deviations) and indexing/action/bank.py (fuse_terms), which stand in for it. */
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#if defined(__AVX__)
#include <immintrin.h>
#endif

#define JOIN_(name, suffix) name##_##suffix
#define JOIN(name, suffix) JOIN_(name, suffix)
#define EXPORT(name) __attribute__((visibility("default"))) JOIN(name, SUFFIX)

enum { WIDE = 2 * LANES, MAX_WIDTH = 9, MAX_SLOPES = 28, PANEL = 32, ROUNDS = LANES == 8 ? 2 : 1, QUERIES = 3, FEW = 4 };
#define UNROLLED static inline __attribute__((always_inline))
typedef float floats __attribute__((vector_size(8 * LANES)));
typedef float unaligned_floats __attribute__((vector_size(8 * LANES), aligned(4)));
typedef int ints __attribute__((vector_size(8 * LANES)));

static inline floats all(float a) { return a - (floats){0}; }
static inline floats where(ints m, floats a, floats b) { return (floats)(((ints)a & m) | ((ints)b & ~m)); }
#if defined(__AVX512F__)  /* one instruction, which the compiler does not find; of NaN and a number they take the second */
static inline floats larger(floats a, floats b) { return (floats)_mm512_max_ps((__m512)a, (__m512)b); }
static inline floats smaller(floats a, floats b) { return (floats)_mm512_min_ps((__m512)a, (__m512)b); }
#elif defined(__AVX__)
static inline floats larger(floats a, floats b) { return (floats)_mm256_max_ps((__m256)a, (__m256)b); }
static inline floats smaller(floats a, floats b) { return (floats)_mm256_min_ps((__m256)a, (__m256)b); }
#else
static inline floats larger(floats a, floats b) { return where(a > b, a, b); }
static inline floats smaller(floats a, floats b) { return where(a < b, a, b); }
#endif
static inline floats absolute(floats a) { return (floats)((ints)a & 0x7fffffff); }
static inline floats root(floats a) { floats r; for (int v = 0; v < WIDE; v++) r[v] = sqrtf(a[v]); return r; }

/* Batcher's network, as far as the lower half of 28, or of 9, needs it. */
#define SORT_28 \
  S(0,1) S(2,3) S(4,5) S(6,7) S(8,9) S(10,11) S(12,13) S(14,15) S(16,17) S(18,19) S(20,21) S(22,23) S(24,25) S(26,27) S(0,2) \
  S(1,3) S(4,6) S(5,7) S(8,10) S(9,11) S(12,14) S(13,15) S(16,18) S(17,19) S(20,22) S(21,23) S(24,26) S(25,27) S(1,2) S(5,6) \
  S(9,10) S(13,14) S(17,18) S(21,22) S(25,26) S(0,4) S(1,5) S(2,6) S(3,7) S(8,12) S(9,13) S(10,14) S(11,15) S(16,20) S(17,21) \
  S(18,22) S(19,23) S(2,4) S(3,5) S(10,12) S(11,13) S(18,20) S(19,21) S(1,2) S(3,4) S(5,6) S(9,10) S(11,12) S(13,14) S(17,18) \
  S(19,20) S(21,22) S(25,26) S(0,8) S(1,9) S(2,10) S(3,11) S(4,12) S(5,13) S(6,14) S(7,15) S(16,24) S(17,25) S(18,26) \
  S(19,27) S(4,8) S(5,9) S(6,10) S(7,11) S(20,24) S(21,25) S(22,26) S(23,27) S(2,4) S(3,5) S(6,8) S(7,9) S(10,12) S(11,13) \
  S(18,20) S(19,21) S(22,24) S(23,25) S(1,2) S(3,4) S(5,6) S(7,8) S(9,10) S(11,12) S(13,14) S(17,18) S(19,20) S(21,22) \
  S(23,24) S(25,26) S(0,16) S(1,17) S(2,18) S(3,19) S(4,20) S(5,21) S(6,22) S(7,23) S(8,24) S(9,25) S(10,26) S(11,27) S(8,16) \
  S(9,17) S(10,18) S(11,19) S(12,20) S(13,21) S(14,22) S(4,8) S(5,9) S(6,10) S(7,11) S(12,16) S(13,17) S(14,18) S(2,4) S(3,5) \
  S(6,8) S(7,9) S(10,12) S(11,13) S(14,16) S(1,2) S(3,4) S(5,6) S(7,8) S(9,10) S(11,12) S(13,14)
#define SORT_9 \
  S(0,1) S(2,3) S(4,5) S(6,7) S(0,2) S(1,3) S(4,6) S(5,7) S(1,2) S(5,6) S(0,4) S(1,5) S(2,6) S(3,7) S(2,4) S(3,5) S(1,2) \
  S(3,4) S(5,6) S(0,8) S(4,8) S(2,4) S(3,5) S(1,2) S(3,4)
#define S(i, j) { floats a = x[i], b = x[j]; x[i] = smaller(a, b); x[j] = larger(a, b); }

/* The lower median of those that are not NaN, of each lane, of MAX_SLOPES or MAX_WIDTH. */
UNROLLED floats median(const floats *values, const int count) {
  floats x[MAX_SLOPES];
  ints there = (ints){0};
#pragma GCC unroll 28
  for (int i = 0; i < count; i++) {
    ints known = values[i] == values[i];
    x[i] = where(known, values[i], all(INFINITY));
    there -= known;
  }
  if (count == MAX_SLOPES) { SORT_28 } else { SORT_9 }
  floats out = x[0];
  there = (there - 1) / 2;
#pragma GCC unroll 14
  for (int i = 1; i < (count + 1) / 2; i++) out = where(there == i, x[i], out);
  return out;
}

/* Distance of sightings (places (n, dims), times (n)), those of rows (count, ascending), from the robust line through the MAX_WIDTH
   nearest ones on the path, which lies between two cuts, and the spread of these: far, spread (count, dims). */
int EXPORT(robust_deviations)(const double *places, const double *times, const ptrdiff_t *rows, const ptrdiff_t *cuts,
                              ptrdiff_t count, int dims, float *far, float *spread) {
  for (ptrdiff_t at = 0; at < count; at += WIDE) {
    ptrdiff_t own[WIDE], first[WIDE], end[WIDE];
    for (int v = 0; v < WIDE; v++) {
      own[v] = rows[at + v < count ? at + v : count - 1];
      while (cuts[1] <= own[v]) cuts++;
      first[v] = own[v] - MAX_WIDTH / 2 < cuts[1] - MAX_WIDTH ? own[v] - MAX_WIDTH / 2 : cuts[1] - MAX_WIDTH;
      first[v] = first[v] > cuts[0] ? first[v] : cuts[0];
      end[v] = first[v] + MAX_WIDTH < cuts[1] ? first[v] + MAX_WIDTH : cuts[1];
    }
    floats since[MAX_WIDTH], near[MAX_WIDTH];  /* from the sighting itself */
    floats slopes[MAX_SLOPES], inverse[MAX_SLOPES];
    for (int d = 0; d < dims; d++) {
      for (int v = 0; v < WIDE; v++) {
        const double *here = places + own[v] * dims + d;
        for (int i = 0; i < MAX_WIDTH; i++) {
          ptrdiff_t j = first[v] + i < end[v] ? first[v] + i : end[v] - 1;
          near[i][v] = first[v] + i < end[v] ? (float)(places[j * dims + d] - *here) : NAN;
          if (d == 0) since[i][v] = (float)(times[j] - times[own[v]]);
        }
      }
      int some = 0;
      for (int i = 0; i < MAX_WIDTH; i++)  /* neighbours further apart than one step */
        for (int j = i + 2; j < MAX_WIDTH; j++, some++) {
          if (d == 0) inverse[some] = all(1) / (since[j] - since[i]);
          slopes[some] = (near[j] - near[i]) * inverse[some];
        }
      floats slope = median(slopes, MAX_SLOPES), left[MAX_WIDTH], most = all(FLT_MAX);
      slope = smaller(larger(slope, -most), most);
      for (int i = 0; i < MAX_WIDTH; i++) left[i] = near[i] - slope * since[i];
      floats middle = median(left, MAX_WIDTH);
      for (int i = 0; i < MAX_WIDTH; i++) left[i] = absolute(left[i] - middle);
      floats away = absolute(middle), usual = all(1.4826f) * median(left, MAX_WIDTH);
      for (int v = 0; v < WIDE && at + v < count; v++) {
        far[(at + v) * dims + d] = away[v];
        spread[(at + v) * dims + d] = usual[v];
      }
    }
  }
  return 0;
}

/* ---- residuals of all pairs -------------------------------------------------------------------------------------------- */

/* (Q, 2, size), (Q, 3), (E, 2, size), (E, 3) */
typedef struct { const float *left, *left_factor, *right, *right_factor; int size; } Channel;

/* Of each table which terms it multiplies (bits 1 epipolar, 2 the image, 4 the turned card), and (Q, PANEL) products so far. */
typedef struct { int count, every; const int *terms; float epsilon, *products; ptrdiff_t step; } Tables;

/* Products of some queries (2 rows of size each) with a stretch of a panel (size, 2, PANEL): c[query][row][x or y][round]. */
UNROLLED void multiply(const float *left, const float *panel, int size, const int queries, floats c[QUERIES][2][2][ROUNDS]) {
  for (int q = 0; q < queries; q++) for (int a = 0; a < 4; a++) for (int r = 0; r < ROUNDS; r++) c[q][a / 2][a % 2][r] = all(0);
  for (int k = 0; k < size; k++) {
    floats x[2][ROUNDS];
    for (int a = 0; a < 2; a++)
      for (int r = 0; r < ROUNDS; r++) x[a][r] = *(const unaligned_floats *)(panel + (2 * k + a) * PANEL + r * WIDE);
    for (int q = 0; q < queries; q++) for (int row = 0; row < 2; row++) {
      floats one = all(left[(2 * q + row) * (ptrdiff_t)size + k]);
      for (int a = 0; a < 2; a++) for (int r = 0; r < ROUNDS; r++) c[q][row][a][r] += one * x[a][r];
    }
  }
}

/* What is left to 1 of the evidence of some pairs, from c[row][x or y] and both factors, for each term that is asked for. */
UNROLLED void residuals(const floats c[4], const float *l, const floats m[3], int terms, floats epsilon, floats out[3]) {
  if (terms & 1) {
    floats a = c[0] + c[3], b = c[1] - c[2], d = c[0] - c[3], e = c[1] + c[2];
    out[0] = all(0.5f) * (root(a * a + b * b) + root(d * d + e * e));
  }
  if (terms & 6) {
    floats heights = (c[0] * all(l[1]) + c[2] * all(l[2])) * m[1] + (c[1] * all(l[1]) + c[3] * all(l[2])) * m[2];
    floats across = c[0] * all(l[0]) * m[0];
    out[1] = across + heights;
    out[2] = absolute(across) + heights;
  }
  for (int t = 0; t < 3; t++) if (terms & 1 << t) out[t] = larger(all(1) + epsilon - out[t], epsilon);
}

/* Of one query and the exemplars from a place of a panel on: the products so far times what is left of one channel. */
UNROLLED void multiply_left(const floats c[4], const Channel *one, ptrdiff_t query, int place, const float factors[3][PANEL],
                            const Tables *tables, int first) {
  floats m[3], out[3];
  for (int i = 0; i < 3; i++) m[i] = *(const unaligned_floats *)(factors[i] + place);
  residuals(c, one->left_factor + 3 * query, m, tables->every, all(tables->epsilon), out);
  for (int t = 0; t < tables->count; t++) {
    unaligned_floats *product = (unaligned_floats *)(tables->products + t * tables->step + query * PANEL + place);
    floats total = first ? all(1) : *product;
    for (int k = 0; k < 3; k++) if (tables->terms[t] & 1 << k) total *= out[k];
    *product = total;
  }
}

/* One query with some exemplars of one channel, pair by pair: of few queries a panel costs more than its products. */
static void compare_one(const Channel *one, ptrdiff_t query, ptrdiff_t exemplar, int count, const float factors[3][PANEL],
                        const Tables *tables, int first) {
  const float *left = one->left + query * 2 * one->size;
  float c[4][PANEL] = {{0}};
  for (int p = 0; p < count; p++) {
    const float *right = one->right + (exemplar + p) * 2 * one->size;
    floats sums[4] = {all(0), all(0), all(0), all(0)};
    int k = 0;
    for (; k + WIDE <= one->size; k += WIDE) for (int a = 0; a < 4; a++) {
      const float *u = left + a / 2 * one->size + k, *v = right + a % 2 * one->size + k;
      sums[a] += *(const unaligned_floats *)u * *(const unaligned_floats *)v;
    }
    for (int a = 0; a < 4; a++) {
      for (int v = 0; v < WIDE; v++) c[a][p] += sums[a][v];
      for (int i = k; i < one->size; i++) c[a][p] += left[a / 2 * one->size + i] * right[a % 2 * one->size + i];
    }
  }
  for (int place = 0; place < PANEL; place += WIDE) {
    floats four[4];
    for (int a = 0; a < 4; a++) four[a] = *(const unaligned_floats *)(c[a] + place);
    multiply_left(four, one, query, place, factors, tables, first);
  }
}

/* Some queries with a panel of one channel. */
UNROLLED void compare(const Channel *one, ptrdiff_t query, const float *panel, const float factors[3][PANEL], const int queries,
                      const Tables *tables, int first) {
  for (int at = 0; at < PANEL; at += ROUNDS * WIDE) {
    floats c[QUERIES][2][2][ROUNDS];
    multiply(one->left + query * 2 * one->size, panel + at, one->size, queries, c);
    for (int q = 0; q < queries; q++) for (int r = 0; r < ROUNDS; r++) {
      floats four[4] = {c[q][0][0][r], c[q][0][1][r], c[q][1][0][r], c[q][1][1][r]};
      multiply_left(four, one, query + q, at + r * WIDE, factors, tables, first);
    }
  }
}

/* Lower tables (Q, width) to the products of residuals over all channels and terms, where these are less; columns: of each
   exemplar, or NULL.  0, or 1 without memory. */
int EXPORT(lower_residuals)(int channels, const float *const *left, const float *const *left_factors, const float *const *right,
                            const float *const *right_factors, const int *sizes, ptrdiff_t num_queries, ptrdiff_t num_exemplars,
                            int num_tables, const int *terms, float epsilon, float *const *tables, ptrdiff_t width,
                            const ptrdiff_t *columns) {
  int largest = 0, every = 0;
  for (int i = 0; i < channels; i++) largest = sizes[i] > largest ? sizes[i] : largest;
  for (int t = 0; t < num_tables; t++) every |= terms[t];
  ptrdiff_t step = num_queries * PANEL;
  float *panel = malloc(sizeof(float) * ((size_t)2 * largest * PANEL + (size_t)num_tables * step)), factors[3][PANEL];
  if (!panel) return 1;
  Tables products = {num_tables, every, terms, epsilon, panel + 2 * (ptrdiff_t)largest * PANEL, step};
  for (ptrdiff_t e = 0; e < num_exemplars; e += PANEL) {
    int here = num_exemplars - e < PANEL ? (int)(num_exemplars - e) : PANEL;
    for (int i = 0; i < channels; i++) {
      Channel one = {left[i], left_factors[i], right[i], right_factors[i], sizes[i]};
      for (int p = 0; p < PANEL; p++) {
        ptrdiff_t from = e + (p < here ? p : here - 1);
        const float *image = one.right + from * 2 * one.size;
        for (int k = 0; k < one.size && num_queries > FEW; k++) {
          panel[2 * k * PANEL + p] = image[k];
          panel[(2 * k + 1) * PANEL + p] = image[one.size + k];
        }
        for (int k = 0; k < 3; k++) factors[k][p] = one.right_factor[3 * from + k];
      }
      ptrdiff_t q = 0;
      for (; q < num_queries && num_queries <= FEW; q++) compare_one(&one, q, e, here, factors, &products, i == 0);
      for (; q + QUERIES <= num_queries; q += QUERIES) compare(&one, q, panel, factors, QUERIES, &products, i == 0);
      for (; q < num_queries; q++) compare(&one, q, panel, factors, 1, &products, i == 0);
    }
    for (int t = 0; t < num_tables; t++)
      for (ptrdiff_t q = 0; q < num_queries; q++) {
        float *row = tables[t] + q * width;
        const float *found = products.products + t * step + q * PANEL;
        for (int p = 0; p < here; p++) {
          float *place = row + (columns ? columns[e + p] : e + p);
          if (found[p] < *place) *place = found[p];
        }
      }
  }
  free(panel);
  return 0;
}

/* ---- sketches slid along codes ------------------------------------------------------------------------------------------- */

enum { WINDOWS = 64 };

typedef signed char bytes __attribute__((vector_size(16)));
#if defined(__clang__)
#define INTERLEAVED(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define INTERLEAVED(a, b, ...) __builtin_shuffle(a, b, (bytes){__VA_ARGS__})
#endif

/* 16 rows of 16 bytes become columns: rows i and i + 8 interleaved, four times over. */
static inline void transpose(bytes rows[16]) {
  bytes other[16];
#pragma GCC unroll 4
  for (int stage = 0; stage < 4; stage++) {
    bytes *from = stage % 2 ? other : rows, *to = stage % 2 ? rows : other;
#pragma GCC unroll 8
    for (int i = 0; i < 8; i++) {
      to[2 * i] = INTERLEAVED(from[i], from[i + 8], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
      to[2 * i + 1] = INTERLEAVED(from[i], from[i + 8], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    }
  }
}

/* Poses of some rows, codes (rows, 2, k) with their scales, as columns x (2 k, count); gram (3, count): x x, x y, y y of each. */
static void read_poses(const signed char *codes, const float *scales, int k, const ptrdiff_t *rows, int count, float *x,
                       float *gram) {
  int done = 0;
  for (; k == 8 && done + 16 <= count; done += 16) {  /* as bytes they turn in a fifth of the instructions */
    float scale[16];
    bytes turned[16];
    for (int i = 0; i < 16; i++) {
      memcpy(turned + i, codes + rows[done + i] * 16, 16);
      scale[i] = scales[rows[done + i]];
    }
    transpose(turned);
    for (int j = 0; j < 16; j++) for (int i = 0; i < 16; i++) x[j * count + done + i] = turned[j][i] * scale[i];
  }
  for (int i = done; i < count; i++) {
    const signed char *code = codes + rows[i] * 2 * k;
    for (int j = 0; j < 2 * k; j++) x[j * count + i] = code[j] * scales[rows[i]];
  }
  memset(gram, 0, sizeof(float) * 3 * count);
  for (int j = 0; j < k; j++) {
    const float *a = x + j * count, *b = a + k * count;
    for (int i = 0; i < count; i++) {
      gram[i] += a[i] * a[i];
      gram[count + i] += a[i] * b[i];
      gram[2 * count + i] += b[i] * b[i];
    }
  }
}

/* Squared largest canonical correlation of planes: c[d][e] of their axes, the window's Gram (indexing/archive/sketches.py). */
static inline floats correlation(const floats c[2][2], const floats gram[3], float ridge) {
  floats trace = gram[0] + gram[2], g00 = gram[0] + all(ridge) * trace, g01 = gram[1], g11 = gram[2] + all(ridge) * trace;
  floats determinant = g00 * g11 - g01 * g01, inverse = all(1) / where(determinant > 0, determinant, all(INFINITY));
  floats p = c[0][0] * c[0][0] + c[0][1] * c[0][1], q = c[0][0] * c[1][0] + c[0][1] * c[1][1];
  floats r = c[1][0] * c[1][0] + c[1][1] * c[1][1], total = (p * g11 - all(2) * q * g01 + r * g00) * inverse;
  return all(0.5f) * (root(larger(total * total - all(4) * (p * r - q * q) * inverse, all(0))) + total);
}

/* scores (probes, count) of windows whose samples are stride rows apart, with the orthonormal axes (probes, 2, samples, k) of
   examples; they begin at rows first[i], or, without these, at low, low + stride...  0, or 1 without memory. */
int EXPORT(score_windows)(const signed char *codes, const float *scales, int k, const ptrdiff_t *first, ptrdiff_t low,
                          ptrdiff_t count, int stride, int samples, const float *axes, int probes, float ridge, float *scores) {
  int step = first ? WINDOWS : 1, poses = first ? WINDOWS * samples : WINDOWS + samples - 1;
  float *x = malloc(sizeof(float) * ((size_t)(2 * k + 3) * poses + WIDE));
  ptrdiff_t *rows = malloc(sizeof(ptrdiff_t) * poses);
  if (!x || !rows) { free(x); free(rows); return 1; }
  float *grams = x + (size_t)2 * k * poses;
  for (ptrdiff_t at = 0; at < count; at += WINDOWS) {
    int here = count - at < WINDOWS ? (int)(count - at) : WINDOWS;
    for (int i = 0; i < poses; i++) {  /* those beyond the last window repeat it */
      int window = first ? i % WINDOWS : 0, sample = first ? i / WINDOWS : i < here + samples - 1 ? i : here + samples - 2;
      rows[i] = (first ? first[at + (window < here ? window : here - 1)] : low + at * stride) + (ptrdiff_t)sample * stride;
    }
    read_poses(codes, scales, k, rows, poses, x, grams);
    for (int t = 0; t < here; t += 2 * WIDE) {  /* two registers of windows share the example's numbers */
      floats gram[2][3] = {{all(0), all(0), all(0)}, {all(0), all(0), all(0)}};
#pragma GCC unroll 2
      for (int w = 0; w < 2; w++)
        for (int i = 0; i < 3; i++)
          for (int l = 0; l < samples; l++) gram[w][i] += *(const unaligned_floats *)(grams + i * poses + t + w * WIDE + l * step);
      for (int p = 0; p < probes; p++) {
        const float *q = axes + (ptrdiff_t)p * 2 * samples * k;
        floats c[2][2][2] = {{{all(0), all(0)}, {all(0), all(0)}}, {{all(0), all(0)}, {all(0), all(0)}}};
        for (int l = 0; l < samples; l++) for (int j = 0; j < k; j++) {
          floats u = all(q[l * k + j]), v = all(q[(samples + l) * k + j]);
          const float *column = x + j * poses + t + l * step;
          floats a0 = *(const unaligned_floats *)column, a1 = *(const unaligned_floats *)(column + WIDE);
          floats b0 = *(const unaligned_floats *)(column + k * poses), b1 = *(const unaligned_floats *)(column + k * poses + WIDE);
          c[0][0][0] += a0 * u; c[0][0][1] += a0 * v; c[0][1][0] += b0 * u; c[0][1][1] += b0 * v;
          c[1][0][0] += a1 * u; c[1][0][1] += a1 * v; c[1][1][0] += b1 * u; c[1][1][1] += b1 * v;
        }
#pragma GCC unroll 2
        for (int w = 0; w < 2; w++) {
          floats found = correlation(c[w], gram[w], ridge);
          float *place = scores + p * count + at + t + w * WIDE;
          if (t + (w + 1) * WIDE <= here) *(unaligned_floats *)place = found;
          else for (int i = 0; t + w * WIDE + i < here; i++) place[i] = found[i];
        }
      }
    }
  }
  free(x);
  free(rows);
  return 0;
}
