/* Vectors of LANES numbers, and small factorizations of LANES matrices side by side. */
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
