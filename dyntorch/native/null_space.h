/* Null spaces of Grams and of rows; the mathematics is that of dyntorch/numerics/eigenspaces.py. */

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
  p->sum = sums ? harmonic_sum(p, p->image) : all(0);  /* image, step and before: room for four columns */
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
