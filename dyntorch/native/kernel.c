/* Null spaces of many small matrices, LANES problems side by side in vector registers ("batch last"), float64.

   Compiled once per instruction set: -DLANES=8 (AVX-512), 4 (AVX2), 2 (SSE2, NEON), -DSUFFIX=... names the functions.  Plain C
   interface, no state, no other library.  What cannot be certified is reported as such and left to the caller; a problem that is
   not finite spoils none of its neighbours.  The mathematics is that of dyntorch/numerics/eigenspaces.py. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define JOIN_(name, suffix) name##_##suffix
#define JOIN(name, suffix) JOIN_(name, suffix)
#define EXPORT(name) __attribute__((visibility("default"))) JOIN(name, SUFFIX)

typedef double lanes __attribute__((vector_size(8 * LANES)));
typedef double unaligned_lanes __attribute__((vector_size(8 * LANES), aligned(8)));
typedef long long mask __attribute__((vector_size(8 * LANES)));

enum { MAX_DIM = 5, MAX_BLOCK = MAX_DIM + 1, MAX_CORRECTIONS = 9, MAX_SLOTS = 6 };
static const double EPS = 2.220446049250313e-16, TINY = 1e-300;
static const double ANGLE = 1e-11;    /* that a certified eigenspace may be off by, rounding of the Gram apart */
static const double ACCURATE = 1e-6;  /* of the trace: a next eigenvalue below which the rows correct the vectors */

static inline lanes all(double a) { return a - (lanes){0}; }
static inline lanes where(mask m, lanes a, lanes b) { return (lanes)(((mask)a & m) | ((mask)b & ~m)); }
static inline lanes larger(lanes a, lanes b) { return where(a > b, a, b); }
static inline lanes smaller(lanes a, lanes b) { return where(a < b, a, b); }
static inline lanes absolute(lanes a) { return where(a < all(0), -a, a); }
static inline lanes root(lanes a) { lanes r; for (int v = 0; v < LANES; v++) r[v] = sqrt(a[v]); return r; }
static inline int any(mask m) { long long r = 0; for (int v = 0; v < LANES; v++) r |= m[v]; return r != 0; }

static inline lanes dot(const lanes *a, const lanes *b, int size) {
  lanes s = all(0), t = all(0);
  int i = 0;
  for (; i + 1 < size; i += 2) { s += a[i] * b[i]; t += a[i + 1] * b[i + 1]; }
  if (i < size) s += a[i] * b[i];
  return s + t;
}
static inline void scale(lanes *a, lanes factor, int size) { for (int i = 0; i < size; i++) a[i] *= factor; }
static inline void normalize(lanes *a, int size) { scale(a, all(1) / root(larger(dot(a, a, size), all(TINY))), size); }

/* Orthonormal vectors (count, size) with the same span: Gram-Schmidt, every vector twice where there are more than two. */
static void orthonormalize(lanes *block, int count, int size) {
  for (int j = 0; j < count; j++) {
    lanes *column = block + j * size;
    for (int pass = 0; pass < (count > 2 ? 2 : 1); pass++) {
      for (int k = 0; k < j; k++) {
        const lanes *before = block + k * size;
        lanes part = dot(before, column, size);
        for (int i = 0; i < size; i++) column[i] -= part * before[i];
      }
      normalize(column, size);
    }
  }
}

/* Lower Cholesky factor in place, blocks of 4 x 4; the diagonal holds reciprocals.  Lanes whose pivots were all positive. */
static mask cholesky(lanes *restrict L, int D) {
  mask good = all(0) == all(0);
  for (int j = 0; j < D; j += 4) {
    int nj = D - j < 4 ? D - j : 4;
    for (int i = j; i < D; i += 4) {
      int ni = D - i < 4 ? D - i : 4;
      if (nj == 4 && ni == 4) {
        lanes c[4][4];
        for (int a = 0; a < 4; a++) for (int b = 0; b < 4; b++) c[a][b] = L[(i + a) * D + j + b];
        const lanes *r0 = L + i * D, *r1 = r0 + D, *r2 = r1 + D, *r3 = r2 + D;
        const lanes *s0 = L + j * D, *s1 = s0 + D, *s2 = s1 + D, *s3 = s2 + D;
        for (int k = 0; k < j; k++) {
          lanes x0 = r0[k], x1 = r1[k], x2 = r2[k], x3 = r3[k], y = s0[k];
          c[0][0] -= x0 * y; c[1][0] -= x1 * y; c[2][0] -= x2 * y; c[3][0] -= x3 * y; y = s1[k];
          c[0][1] -= x0 * y; c[1][1] -= x1 * y; c[2][1] -= x2 * y; c[3][1] -= x3 * y; y = s2[k];
          c[0][2] -= x0 * y; c[1][2] -= x1 * y; c[2][2] -= x2 * y; c[3][2] -= x3 * y; y = s3[k];
          c[0][3] -= x0 * y; c[1][3] -= x1 * y; c[2][3] -= x2 * y; c[3][3] -= x3 * y;
        }
        for (int a = 0; a < 4; a++) for (int b = 0; b < 4; b++) L[(i + a) * D + j + b] = c[a][b];
      } else {
        for (int a = 0; a < ni; a++) for (int b = 0; b < nj; b++) {
          lanes s = L[(i + a) * D + j + b];
          for (int k = 0; k < j; k++) s -= L[(i + a) * D + k] * L[(j + b) * D + k];
          L[(i + a) * D + j + b] = s;
        }
      }
    }
    for (int b = 0; b < nj; b++) {
      lanes pivot = L[(j + b) * D + j + b];
      mask positive = pivot > all(TINY);
      good &= positive;
      lanes reciprocal = all(1) / root(where(positive, pivot, all(1)));
      L[(j + b) * D + j + b] = reciprocal;
      for (int i = j + b + 1; i < D; i++) {
        lanes x = L[i * D + j + b] * reciprocal;
        L[i * D + j + b] = x;
        for (int c = b + 1; c < nj && j + c <= i; c++) L[i * D + j + c] -= x * (i == j + c ? x : L[(j + c) * D + j + b]);
      }
    }
  }
  return good;
}
static void solve_lower(const lanes *L, int D, lanes *x) {
  for (int i = 0; i < D; i++) {
    lanes s = x[i], t = all(0);
    int k = 0;
    for (; k + 1 < i; k += 2) { s -= L[i * D + k] * x[k]; t -= L[i * D + k + 1] * x[k + 1]; }
    if (k < i) s -= L[i * D + k] * x[k];
    x[i] = (s + t) * L[i * D + i];
  }
}
static void solve_upper(const lanes *L, int D, lanes *x) {
  for (int i = D - 1; i >= 0; i--) {
    lanes t = x[i] * L[i * D + i];
    x[i] = t;
    for (int k = 0; k < i; k++) x[k] -= L[i * D + k] * t;
  }
}
static void solve(const lanes *L, int D, lanes *x) { solve_lower(L, D, x); solve_upper(L, D, x); }

/* y = G x for the lower triangle of a symmetric G. */
static void multiply(const lanes *G, int D, const lanes *x, lanes *y) {
  for (int i = 0; i < D; i++) y[i] = all(0);
  for (int i = 0; i < D; i++) {
    lanes s = G[i * D + i] * x[i], t = x[i];
    for (int k = 0; k < i; k++) { s += G[i * D + k] * x[k]; y[k] += G[i * D + k] * t; }
    y[i] += s;
  }
}

/* Eigenvalues, ascending, and vectors (columns of R) of symmetric matrices of up to 6 rows: cyclic Jacobi. */
static void eigen_small(lanes A[MAX_BLOCK][MAX_BLOCK], lanes R[MAX_BLOCK][MAX_BLOCK], int size) {
  for (int i = 0; i < size; i++) for (int j = 0; j < size; j++) R[i][j] = all(i == j);
  for (int sweep = 0; sweep < (size > 2 ? 7 : 1); sweep++)
    for (int p = 0; p < size; p++) for (int q = p + 1; q < size; q++) {
      lanes twice = all(2) * A[p][q], difference = A[q][q] - A[p][p];
      lanes length = root(difference * difference + twice * twice) + absolute(difference);
      lanes t = where(difference < all(0), -twice, twice) / larger(length, all(TINY));
      lanes c = all(1) / root(all(1) + t * t), s = t * c;
      for (int k = 0; k < size; k++) { lanes x = A[k][p], y = A[k][q]; A[k][p] = c * x - s * y; A[k][q] = s * x + c * y; }
      for (int k = 0; k < size; k++) { lanes x = A[p][k], y = A[q][k]; A[p][k] = c * x - s * y; A[q][k] = s * x + c * y; }
      for (int k = 0; k < size; k++) { lanes x = R[k][p], y = R[k][q]; R[k][p] = c * x - s * y; R[k][q] = s * x + c * y; }
    }
  for (int end = size - 1; end > 0; end--) for (int i = 0; i < end; i++) {
    mask swap = A[i + 1][i + 1] < A[i][i];
    lanes x = A[i][i], y = A[i + 1][i + 1];
    A[i][i] = where(swap, y, x);
    A[i + 1][i + 1] = where(swap, x, y);
    for (int k = 0; k < size; k++) { x = R[k][i]; y = R[k][i + 1]; R[k][i] = where(swap, y, x); R[k][i + 1] = where(swap, x, y); }
  }
}

/* Ritz vectors and ascending values in the span of orthonormal vectors (count, D). */
static void ritz(const lanes *G, int D, lanes *block, int count, lanes *image, lanes *values) {
  lanes A[MAX_BLOCK][MAX_BLOCK], R[MAX_BLOCK][MAX_BLOCK];
  for (int j = 0; j < count; j++) multiply(G, D, block + j * D, image + j * D);
  for (int i = 0; i < count; i++) for (int j = 0; j <= i; j++) A[i][j] = A[j][i] = dot(block + i * D, image + j * D, D);
  eigen_small(A, R, count);
  for (int j = 0; j < count; j++) values[j] = A[j][j];
  for (int i = 0; i < D; i++) {
    lanes x[MAX_BLOCK];
    for (int j = 0; j < count; j++) x[j] = block[j * D + i];
    for (int j = 0; j < count; j++) {
      lanes s = all(0);
      for (int k = 0; k < count; k++) s += R[k][j] * x[k];
      block[j * D + i] = s;
    }
  }
}

typedef struct {
  int D, dim;
  lanes *G, *L, *S;      /* (D, D): Gram of trace 1, factor of G + D eps I, factor of G - shift I + V V^T */
  lanes *block, *image;  /* (dim + 1, D) */
  lanes *step;           /* (dim, D) */
  lanes *before;         /* (dim, D) */
  lanes scale, next, sum, values[MAX_BLOCK];
  mask certified;
} Pack;

static size_t pack_size(int D, int dim) { return 3 * (size_t)D * D + (4 * (size_t)dim + 2) * D; }
static void pack_on(Pack *p, lanes *memory, int D, int dim) {
  p->D = D; p->dim = dim;
  p->G = memory; p->L = p->G + (size_t)D * D; p->S = p->L + (size_t)D * D;
  p->block = p->S + (size_t)D * D; p->image = p->block + (dim + 1) * D; p->step = p->image + (dim + 1) * D; p->before = p->step + dim * D;
}

/* Moves the vectors of the wanted problems by their steps; the others stay bit for bit, whatever their neighbours need. */
static void move(Pack *p, mask wanted) {
  int D = p->D, dim = p->dim;
  memcpy(p->before, p->block, sizeof(lanes) * dim * D);
  for (int k = 0; k < dim * D; k++) p->block[k] -= p->step[k];
  orthonormalize(p->block, dim, D);
  for (int k = 0; k < dim * D; k++) p->block[k] = where(wanted, p->block[k], p->before[k]);
}

/* One Newton correction of the Ritz vectors; the angle that is left beyond what rounding of the Gram explains. */
static lanes correct(Pack *p, lanes sigma, mask wanted) {
  int D = p->D, dim = p->dim;
  lanes small[MAX_DIM][MAX_DIM], values[MAX_DIM], contraction = all(0), length = all(0);
  for (int j = 0; j < dim; j++) multiply(p->G, D, p->block + j * D, p->image + j * D);
  for (int i = 0; i < dim; i++) for (int j = 0; j <= i; j++) small[i][j] = small[j][i] = dot(p->block + i * D, p->image + j * D, D);
  lanes gap = larger(all(.25) * (p->next - sigma), all(EPS));
  for (int j = 0; j < dim; j++) {
    lanes *residual = p->image + j * D, *step = p->step + j * D;
    for (int k = 0; k < dim; k++) for (int i = 0; i < D; i++) residual[i] -= small[k][j] * p->block[k * D + i];
    memcpy(step, residual, sizeof(lanes) * D);
    solve(p->S, D, step);
    values[j] = small[j][j];
    for (int inner = 0; inner < (dim > 1 ? 2 : 0); inner++) {  /* towards the shift of each vector */
      lanes shift = sigma - values[j];
      for (int i = 0; i < D; i++) step[i] = residual[i] - step[i] * shift;
      solve(p->S, D, step);
    }
    values[j] -= dot(step, residual, D);
    contraction = larger(contraction, absolute(sigma - values[j]) / gap);
    length += dot(step, step, D);
    p->values[j] = where(wanted, values[j], p->values[j]);
  }
  move(p, wanted);
  if (dim > 1) contraction = contraction * contraction * contraction;
  length = root(length);
  return length * (contraction + length) - all(EPS) / gap;
}

/* Sum of 1 / eigenvalue outside the null space: |L^-1|^2 - |L^-1 V|^2, the inverse four columns at a time. */
static lanes harmonic_sum(const Pack *p, lanes *scratch) {
  int D = p->D;
  const lanes *L = p->L;
  lanes total = all(0);
  for (int j = 0; j < D; j += 4) {
    int nj = D - j < 4 ? D - j : 4;
    for (int i = j; i < D; i++) {
      lanes sum[4];
      for (int b = 0; b < 4; b++) sum[b] = all(i == j + b);
      for (int k = j; k < i; k++) {
        lanes l = L[i * D + k];
        const lanes *z = scratch + 4 * k;
        sum[0] -= l * z[0]; sum[1] -= l * z[1]; sum[2] -= l * z[2]; sum[3] -= l * z[3];
      }
      for (int b = 0; b < 4; b++) {
        lanes z = sum[b] * L[i * D + i];
        scratch[4 * i + b] = z;
        if (b < nj) total += z * z;
      }
    }
  }
  for (int j = 0; j < p->dim; j++) {
    memcpy(scratch, p->block + j * D, sizeof(lanes) * D);
    solve_lower(L, D, scratch);
    total -= dot(scratch, scratch, D);
  }
  return larger(total, all(0));
}

/* The null spaces of the Grams in p->G (lower triangles, any scale): subspace iteration with the inverse, deflated Cholesky
   certificate, Newton corrections. */
static void null_spaces(Pack *p, const double *generic, int sums) {
  int D = p->D, dim = p->dim;
  lanes trace = all(0);
  for (int i = 0; i < D; i++) trace += p->G[i * D + i];
  mask finite = (trace > all(TINY)) & (trace < all(1 / TINY));
  p->scale = where(finite, all(1) / where(finite, trace, all(1)), all(1));
  for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) {
    lanes g = where(finite, p->G[i * D + j] * p->scale, all(i == j ? 1.0 / D : 0));
    p->G[i * D + j] = g;
    p->L[i * D + j] = i == j ? g + all(D * EPS) : g;
  }
  mask sound = finite & cholesky(p->L, D);
  for (int j = 0; j <= dim; j++) {  /* half an iteration: any start is as good as any other */
    for (int i = 0; i < D; i++) p->block[j * D + i] = all(generic[j * D + i]);
    solve_upper(p->L, D, p->block + j * D);
  }
  orthonormalize(p->block, dim + 1, D);
  for (int iteration = 0; iteration < 2; iteration++) {
    for (int j = 0; j <= dim; j++) solve(p->L, D, p->block + j * D);
    orthonormalize(p->block, dim + 1, D);
  }
  ritz(p->G, D, p->block, dim + 1, p->image, p->values);
  lanes sigma = smaller(larger(p->values[dim - 1], all(0)), all(1));
  p->next = p->values[dim];
  for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) {
    lanes g = p->G[i * D + j];
    for (int k = 0; k < dim; k++) g += p->block[k * D + i] * p->block[k * D + j];
    p->S[i * D + j] = i == j ? g - sigma : g;
  }
  sound &= cholesky(p->S, D);
  lanes bound = all(1);
  mask wanted = sound;
  for (int correction = 0; correction < MAX_CORRECTIONS && any(wanted); correction++) {
    bound = where(wanted, correct(p, sigma, wanted), bound);
    wanted = sound & (bound > all(ANGLE));
  }
  if (dim > 1) ritz(p->G, D, p->block, dim, p->image, p->values);
  p->certified = sound & (bound <= all(ANGLE));
  p->sum = sums ? harmonic_sum(p, p->S) : all(0);
}

/* Fixed directions without symmetry (count, size), the same as in eigenspaces.py. */
static void generic_directions(double *out, int count, int size) {
  for (int i = 0; i < count * size; i++) {
    double t = (i + 1) * 0.6180339887498949, k = i + 1;
    out[i] = t - floor(t) + .1 * cos(k * k) - .5;
  }
}

typedef struct {
  double *basis, *values, *sum, *next;  /* (batch, dim, D), (batch, dim), (batch), (batch): next in units of the trace */
  unsigned char *certified;
} Answers;

static void write_answers(const Pack *p, const Answers *out, ptrdiff_t first, int count, const double *generic) {
  int D = p->D, dim = p->dim;
  for (int v = 0; v < count; v++) {
    for (int j = 0; j < dim; j++) {
      double side = 0;
      for (int i = 0; i < D; i++) side += generic[i] * p->block[j * D + i][v];
      double *vector = out->basis + ((first + v) * dim + j) * D;
      for (int i = 0; i < D; i++) vector[i] = side < 0 ? -p->block[j * D + i][v] : p->block[j * D + i][v];
      if (out->values) out->values[(first + v) * dim + j] = (p->values[j][v] > 0 ? p->values[j][v] : 0) / p->scale[v];
    }
    if (out->sum) out->sum[first + v] = p->sum[v] * p->scale[v];
    out->next[first + v] = p->next[v];
    out->certified[first + v] = p->certified[v] != 0;
  }
}

/* One aligned block of memory: lanes first, then the generic directions, then `extra` doubles.  NULL: there is none left. */
static lanes *workspace(Pack *p, int D, int dim, size_t extra, double **generic, double **rest) {
  size_t bytes = sizeof(lanes) * pack_size(D, dim) + sizeof(double) * ((size_t)(dim + 1) * D + LANES + extra);
  lanes *memory = aligned_alloc(64, (bytes + 63) / 64 * 64);
  if (!memory) return NULL;
  pack_on(p, memory, D, dim);
  *generic = (double *)(memory + pack_size(D, dim));
  generic_directions(*generic, dim + 1, D);
  *rest = (double *)(memory + pack_size(D, dim) + ((size_t)(dim + 1) * D + LANES - 1) / LANES);
  return memory;
}

/* gram (batch, D, D) -> basis (batch, dim, D), values (batch, dim), sum of 1 / eigenvalue over the others, next eigenvalue
   over the trace, whether certified.  0, or 1 without memory. */
int EXPORT(null_of_grams)(const double *gram, ptrdiff_t batch, int D, int dim, double *basis, double *values, double *sum,
                          double *next, unsigned char *certified) {
  Pack p;
  double *generic, *rest;
  lanes *memory = workspace(&p, D, dim, 0, &generic, &rest);
  if (!memory) return 1;
  Answers out = {basis, values, sum, next, certified};
  for (ptrdiff_t first = 0; first < batch; first += LANES) {
    int count = batch - first < LANES ? (int)(batch - first) : LANES;
    for (int v = 0; v < LANES; v++) {
      const double *source = gram + (first + (v < count ? v : count - 1)) * D * D;
      for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) ((double *)(p.G + i * D + j))[v] = source[i * D + j];
    }
    null_spaces(&p, generic, 1);
    write_answers(&p, &out, first, count, generic);
  }
  free(memory);
  return 0;
}

#if LANES >= 8
enum { TALL = 6, WIDE = 4 };
#else
enum { TALL = 4, WIDE = 3 };
#endif

/* Lower triangle of the Gram of one problem (rows, D), entry (i, j) at out[(i D + j) stride]; `padded`: room for its rows. */
static void gram_of_rows(const double *A, ptrdiff_t rows, int D, double *out, int stride, double *padded) {
  int registers = (D + LANES - 1) / LANES, width = registers * LANES;
  if (width != D) {
    for (ptrdiff_t r = 0; r < rows; r++) {
      memcpy(padded + r * width, A + r * D, sizeof(double) * D);
      for (int k = D; k < width; k++) padded[r * width + k] = 0;
    }
    A = padded;
  }
  for (int i = 0; i < D; i += TALL) {
    int ni = D - i < TALL ? D - i : TALL, last = (i + ni - 1) / LANES;
    for (int c0 = 0; c0 <= last; c0 += WIDE) {
      int nc = last - c0 + 1 < WIDE ? last - c0 + 1 : WIDE;
      lanes sum[TALL][WIDE];
      for (int a = 0; a < TALL; a++) for (int c = 0; c < WIDE; c++) sum[a][c] = all(0);
#define ADD_ROWS(COUNT) \
  for (ptrdiff_t r = 0; r < rows; r++) { \
    const double *row = A + r * width; \
    lanes x[COUNT]; \
    for (int c = 0; c < COUNT; c++) x[c] = *(const unaligned_lanes *)(row + LANES * (c0 + c)); \
    for (int a = 0; a < TALL; a++) { \
      lanes m = all(row[i + a < D ? i + a : D - 1]); \
      for (int c = 0; c < COUNT; c++) sum[a][c] += m * x[c]; \
    } \
  }
      if (nc == 1) { ADD_ROWS(1) }
      else if (nc == 2) { ADD_ROWS(2) }
      else if (nc == 3) { ADD_ROWS(3) }
#if LANES >= 8
      else { ADD_ROWS(4) }
#endif
      for (int a = 0; a < ni; a++) for (int c = 0; c < nc; c++) for (int l = 0; l < LANES; l++) {
        int j = LANES * (c0 + c) + l;
        if (j <= i + a) out[((i + a) * D + j) * (ptrdiff_t)stride] = sum[a][c][l];
      }
    }
  }
}

/* Newton corrections whose residual comes from the rows: the error is that of the SVD, eps kappa, not eps kappa^2. */
static void correct_by_rows(Pack *p, const double *const *A, ptrdiff_t rows, mask wanted, double *scratch) {
  int D = p->D, dim = p->dim;
  double *vectors = scratch, *residual = scratch + dim * D, *image = residual + dim * D;
  for (int pass = 0; pass < 2; pass++) {
    for (int v = 0; v < LANES; v++) {
      if (!wanted[v]) {
        for (int k = 0; k < dim * D; k++) p->step[k][v] = 0;
        continue;
      }
      for (int k = 0; k < dim * D; k++) { vectors[k] = p->block[k][v]; residual[k] = 0; }
      double square[MAX_DIM][MAX_DIM] = {{0}};
      for (ptrdiff_t r = 0; r < rows; r++) {
        const double *row = A[v] + r * D;
        for (int j = 0; j < dim; j++) {
          double s = 0;
          for (int k = 0; k < D; k++) s += row[k] * vectors[j * D + k];
          image[j] = s;
        }
        for (int j = 0; j < dim; j++) {
          for (int k = 0; k < D; k++) residual[j * D + k] += image[j] * row[k];
          for (int i = 0; i < dim; i++) square[i][j] += image[i] * image[j];
        }
      }
      for (int j = 0; j < dim; j++) for (int k = 0; k < D; k++) {
        double r = residual[j * D + k];
        for (int i = 0; i < dim; i++) r -= square[i][j] * vectors[i * D + k];
        p->step[j * D + k][v] = r * p->scale[v];
      }
    }
    for (int j = 0; j < dim; j++) solve(p->S, D, p->step + j * D);
    move(p, wanted);
  }
}

/* rows (batch, rows, D) -> basis (batch, dim, D), next eigenvalue of the Gram over its trace, whether certified, and the Grams
   (batch, D, D) unless NULL.  `always`: corrected by the rows whatever the next eigenvalue. */
int EXPORT(null_of_rows)(const double *matrix, ptrdiff_t batch, ptrdiff_t rows, int D, int dim, int always, double *basis,
                         double *next, unsigned char *certified, double *gram) {
  Pack p;
  double *generic, *rest;
  size_t padded = (size_t)(rows + 1) * (D + LANES), scratch = (2 * (size_t)dim + 1) * D + MAX_DIM;
  lanes *memory = workspace(&p, D, dim, padded + scratch + LANES, &generic, &rest);
  if (!memory) return 1;
  Answers out = {basis, NULL, NULL, next, certified};
  for (ptrdiff_t first = 0; first < batch; first += LANES) {
    int count = batch - first < LANES ? (int)(batch - first) : LANES;
    const double *A[LANES];
    for (int v = 0; v < LANES; v++) {
      A[v] = matrix + (first + (v < count ? v : count - 1)) * rows * D;
      if (v < count) gram_of_rows(A[v], rows, D, (double *)p.G + v, LANES, rest);
      else for (int i = 0; i < D * D; i++) p.G[i][v] = p.G[i][count - 1];
    }
    if (gram)
      for (int v = 0; v < count; v++) for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++)
        gram[((first + v) * D + i) * D + j] = gram[((first + v) * D + j) * D + i] = p.G[i * D + j][v];
    null_spaces(&p, generic, 0);
    mask inexact = p.certified;
    if (!always) inexact &= p.next <= all(ACCURATE);
    if (any(inexact)) correct_by_rows(&p, A, rows, inexact, rest + padded);
    write_answers(&p, &out, first, count, generic);
  }
  free(memory);
  return 0;
}

/* ---- fits: matches -> similarities -> moments of products of slots -> null spaces, in one pass -------------------------- */

enum { POINT, HYPERPLANES_THROUGH, CONIC_MONOMIALS };  /* what a measured point x of dimension d puts into a slot */
enum { CHUNK = 512, NEXT_ITERATIONS = 8, MAX_SPACE = 8 };

typedef struct {
  int kind, dim;
  const double *x;             /* (batch, n, dim), strides in doubles */
  ptrdiff_t batch, match, coordinate;
} Slot;

static int slot_width(const Slot *s) { return s->kind == CONIC_MONOMIALS ? 6 : s->dim + 1; }
static int packed_size(const Slot *s) { int w = slot_width(s); return w * (w + 1) / 2; }

/* Hartley's similarity: scale, and centre (dim); points that are equal to rounding keep their scale. */
static double similarity(const Slot *s, const double *x, const double *weights, ptrdiff_t n, double *centre) {
  double total = 0, spread = 0, away = 0;
  for (ptrdiff_t k = 0; k < n; k++) total += weights[k];
  total = total > 2.2250738585072014e-308 ? total : 2.2250738585072014e-308;
  for (int c = 0; c < s->dim; c++) {
    const double *column = x + c * s->coordinate;
    double sum = 0, squares = 0;
    for (ptrdiff_t k = 0; k < n; k++) sum += weights[k] * column[k * s->match];
    sum /= total;
    for (ptrdiff_t k = 0; k < n; k++) { double d = column[k * s->match] - sum; squares += weights[k] * d * d; }
    centre[c] = sum;
    spread += squares / total;
    away += sum * sum;
  }
  double least = 1e-28 * away > 1e-120 ? 1e-28 * away : 1e-120;
  return spread > least ? sqrt(s->dim / spread) : 1;
}

/* Upper triangles of the outer products of the slot's vectors of some matches, component first: out (packed, width). */
static void pack_slot(const Slot *s, const double *x, ptrdiff_t count, int width, double scale_, const double *centre,
                      const double *weights, double *out) {
  double moved[MAX_SPACE + 1][CHUNK + 8];
  int d = s->dim, row = 0;
  for (int c = 0; c < d; c++) {
    for (ptrdiff_t k = 0; k < count; k++) moved[c][k] = (x[k * s->match + c * s->coordinate] - centre[c]) * scale_;
    for (ptrdiff_t k = count; k < width; k++) moved[c][k] = 0;
  }
  for (int k = 0; k < width; k++) moved[d][k] = 1;
  if (s->kind == CONIC_MONOMIALS) {  /* of the point (x, y, 1), each scaled by the root of how often it occurs */
    double factor = 1.4142135623730951, mono[6];
    for (int k = 0; k < width; k++) {
      double a = moved[0][k], b = moved[1][k];
      mono[0] = a * a; mono[1] = factor * a * b; mono[2] = factor * a; mono[3] = b * b; mono[4] = factor * b; mono[5] = 1;
      for (int i = 0, r = 0; i < 6; i++) for (int j = i; j < 6; j++, r++) out[r * width + k] = mono[i] * mono[j];
    }
    row = 21;
  } else if (s->kind == POINT) {
    for (int i = 0; i <= d; i++) for (int j = i; j <= d; j++, row++)
      for (int k = 0; k < width; k++) out[row * width + k] = moved[i][k] * moved[j][k];
  } else {  /* the rows of [I | -x] */
    for (int i = 0; i <= d; i++) for (int j = i; j <= d; j++, row++) {
      double *entry = out + row * width;
      if (j < d) for (int k = 0; k < width; k++) entry[k] = i == j;
      else if (i < d) for (int k = 0; k < width; k++) entry[k] = -moved[i][k];
      else for (int k = 0; k < width; k++) {
        double sum = 0;
        for (int c = 0; c < d; c++) sum += moved[c][k] * moved[c][k];
        entry[k] = sum;
      }
    }
  }
  if (weights)
    for (int r = 0; r < row; r++) for (int k = 0; k < width; k++) out[r * width + k] *= k < count ? weights[k] : 0;
}

/* Sums over the matches of the products of packed slots, added to moments[(i right + r) stride]. */
static void add_moments(double *const *packed, const int *sizes, int slots, int width, double *moments, int stride, double *room) {
  int right = 1, blocks = width / LANES;
  for (int s = 1; s < slots; s++) right *= sizes[s];
  for (int r0 = 0; r0 < right; r0 += WIDE) {
    int nr = right - r0 < WIDE ? right - r0 : WIDE;
    const lanes *columns[WIDE];
    for (int r = 0; r < WIDE; r++) {
      int digits = r0 + (r < nr ? r : nr - 1);
      const double *row = packed[slots - 1] + (digits % sizes[slots - 1]) * width;
      digits /= sizes[slots - 1];
      for (int s = slots - 2; s > 0; s--) {
        const double *other = packed[s] + (digits % sizes[s]) * width;
        double *product = room + r * width;
        for (int k = 0; k < width; k++) product[k] = row[k] * other[k];
        row = product;
        digits /= sizes[s];
      }
      columns[r] = (const lanes *)row;
    }
    for (int i = 0; i < sizes[0]; i += TALL) {
      int ni = sizes[0] - i < TALL ? sizes[0] - i : TALL;
      const lanes *left[TALL];
      for (int a = 0; a < TALL; a++) left[a] = (const lanes *)(packed[0] + (i + (a < ni ? a : ni - 1)) * width);
      lanes sum[TALL][WIDE];
      for (int a = 0; a < TALL; a++) for (int r = 0; r < WIDE; r++) sum[a][r] = all(0);
      for (int k = 0; k < blocks; k++) {
        lanes x[WIDE];
        for (int r = 0; r < WIDE; r++) x[r] = columns[r][k];
        for (int a = 0; a < TALL; a++) { lanes m = left[a][k]; for (int r = 0; r < WIDE; r++) sum[a][r] += m * x[r]; }
      }
      for (int a = 0; a < ni; a++) for (int r = 0; r < nr; r++) {
        double total = 0;
        for (int l = 0; l < LANES; l++) total += sum[a][r][l];
        moments[((ptrdiff_t)(i + a) * right + r0 + r) * stride] += total;
      }
    }
  }
}

/* Where entry (i, j), j <= i, of the Gram of products of slots lies among the packed moments. */
static void unpacking(const Slot *slots, int count, int D, int *index) {
  for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) {
    int a = i, b = j, place = 0, base = 1;
    for (int s = count - 1; s >= 0; s--) {
      int w = slot_width(slots + s), x = a % w, y = b % w, low = x < y ? x : y, high = x < y ? y : x;
      place += base * (low * w - low * (low - 1) / 2 + high - low);
      base *= w * (w + 1) / 2;
      a /= w; b /= w;
    }
    index[i * D + j] = place;
  }
}

/* The vector of the next eigenvalue: inverse iteration on the deflated factor. */
static void next_vector(Pack *p) {
  int D = p->D;
  lanes *x = p->block + p->dim * D;
  for (int iteration = 0; iteration < NEXT_ITERATIONS; iteration++) {
    for (int j = 0; j < p->dim; j++) {
      lanes part = dot(p->block + j * D, x, D);
      for (int i = 0; i < D; i++) x[i] -= part * p->block[j * D + i];
    }
    solve(p->S, D, x);
    normalize(x, D);
  }
}

/* Fits of a batch: slots described by kinds, dims, pointers and strides (3 each), weights (batch, n) of at most 1 ->
   scales (batch, slots) and centres (batch, slots, MAX_SPACE) of the similarities, null spaces (batch, dim, D) of the normalized
   matches, vectors of the next eigenvalue (batch, D), values, sums, trace, next over trace, certified.  0, or 1 without memory. */
int EXPORT(fit_points)(int slots, const int *kinds, const int *dims, const double *const *views, const ptrdiff_t *strides,
                       const double *weights, ptrdiff_t batch, ptrdiff_t n, int dim, int normalized, double *scales,
                       double *centres, double *basis, double *second, double *values, double *sum, double *trace, double *next,
                       unsigned char *certified) {
  Slot slot[MAX_SLOTS];
  int sizes[MAX_SLOTS], D = 1, all_packed = 0, chunk = n < CHUNK ? (int)(n + LANES - 1) / LANES * LANES : CHUNK;
  size_t moments_size = 1;
  for (int s = 0; s < slots; s++) {
    slot[s] = (Slot){kinds[s], dims[s], views[s], strides[3 * s], strides[3 * s + 1], strides[3 * s + 2]};
    sizes[s] = packed_size(slot + s);
    D *= slot_width(slot + s);
    all_packed += sizes[s];
    moments_size *= sizes[s];
  }
  Pack p;
  double *generic, *rest;
  size_t packed_room = (size_t)all_packed * chunk, extra = moments_size * LANES + packed_room + (WIDE + 1) * (size_t)chunk + LANES;
  lanes *memory = workspace(&p, D, dim, extra, &generic, &rest);
  int *index = malloc(sizeof(int) * D * D);
  if (!memory || !index) { free(memory); free(index); return 1; }
  double *moments = rest, *packed[MAX_SLOTS], *room;
  packed[0] = moments + moments_size * LANES;
  for (int s = 1; s < slots; s++) packed[s] = packed[s - 1] + (size_t)sizes[s - 1] * chunk;
  room = packed[slots - 1] + (size_t)sizes[slots - 1] * chunk;
  unpacking(slot, slots, D, index);
  Answers out = {basis, values, sum, next, certified};
  for (ptrdiff_t first = 0; first < batch; first += LANES) {
    int count = batch - first < LANES ? (int)(batch - first) : LANES;
    memset(moments, 0, sizeof(double) * moments_size * LANES);
    for (int v = 0; v < count; v++) {
      const double *w = weights + (first + v) * n;
      double *scale_ = scales + (first + v) * slots, *centre = centres + (first + v) * slots * MAX_SPACE;
      for (int s = 0; s < slots; s++) {
        for (int c = 0; c < MAX_SPACE; c++) centre[s * MAX_SPACE + c] = 0;
        scale_[s] = normalized ? similarity(slot + s, slot[s].x + (first + v) * slot[s].batch, w, n, centre + s * MAX_SPACE) : 1;
      }
      for (ptrdiff_t start = 0; start < n; start += chunk) {
        ptrdiff_t some = n - start < chunk ? n - start : chunk;
        int width = (int)(some + LANES - 1) / LANES * LANES;
        for (int s = 0; s < slots; s++)
          pack_slot(slot + s, slot[s].x + (first + v) * slot[s].batch + start * slot[s].match, some, width, scale_[s],
                    centre + s * MAX_SPACE, s == 0 ? w + start : NULL, packed[s]);
        add_moments(packed, sizes, slots, width, moments + v, LANES, room);
      }
    }
    for (int v = count; v < LANES; v++) for (size_t k = 0; k < moments_size; k++) moments[k * LANES + v] = moments[k * LANES + count - 1];
    for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) p.G[i * D + j] = *(const lanes *)(moments + (ptrdiff_t)index[i * D + j] * LANES);
    for (int v = 0; v < count; v++) {
      trace[first + v] = 0;
      for (int i = 0; i < D; i++) trace[first + v] += p.G[i * D + i][v];
    }
    null_spaces(&p, generic, 0);
    next_vector(&p);
    p.sum = harmonic_sum(&p, p.S);
    write_answers(&p, &out, first, count, generic);
    for (int v = 0; v < count; v++) for (int i = 0; i < D; i++) second[(first + v) * D + i] = p.block[dim * D + i][v];
  }
  free(memory);
  free(index);
  return 0;
}

#if LANES == 2
/* What is asked once per library: which instruction sets this processor has, and which source this was made from. */
__attribute__((visibility("default"))) int has_instructions(int wanted) {
#if defined(__x86_64__)
  if (wanted == 8) return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  if (wanted == 4) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
  return wanted == 2;
}
__attribute__((visibility("default"))) const char *made_from(void) { return SOURCE; }
#endif
