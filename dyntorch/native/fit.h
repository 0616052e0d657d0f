/* Fits: matches -> similarities -> moments of products of slots -> null spaces, in one pass. */

enum { POINT, HYPERPLANES_THROUGH, CONIC_MONOMIALS, VECTORS };  /* what a measured point x of dimension d puts into a slot */
enum { MAX_ROWS = 1 << 20, CHUNK = 512, NEXT_ITERATIONS = 8, MAX_SPACE = 8 };

typedef struct {
  int kind, dim;
  const double *x;             /* (batch, n, dim), strides in doubles */
  ptrdiff_t batch, match, coordinate;
} Slot;

static int slot_width(const Slot *s) { return s->kind == CONIC_MONOMIALS ? 6 : s->dim + (s->kind != VECTORS); }
static int packed_size(const Slot *s) { int w = slot_width(s); return w * (w + 1) / 2; }

/* Sum over `width` matches, a multiple of LANES, of w (x - shift)^power. */
static double weighted_sum(const double *w, const double *x, double shift, int power, ptrdiff_t width) {
  lanes sum = all(0), more = all(0);
  for (ptrdiff_t k = 0; k < width; k += LANES) {
    lanes away = *(const unaligned_lanes *)(x + k) - shift, part = *(const unaligned_lanes *)(w + k) * away;
    if (k / LANES % 2) more += power > 1 ? part * away : part;
    else sum += power > 1 ? part * away : part;
  }
  double total = 0;
  for (int v = 0; v < LANES; v++) total += sum[v] + more[v];
  return total;
}

/* Hartley's similarity: scale, and centre (dim); points that are equal to rounding keep their scale.  columns (dim, width). */
static double similarity(const double *columns, int dim, const double *weights, double total, ptrdiff_t width, double *centre) {
  double spread = 0, away = 0;
  for (int c = 0; c < dim; c++) {
    centre[c] = weighted_sum(weights, columns + c * width, 0, 1, width) / total;
    spread += weighted_sum(weights, columns + c * width, centre[c], 2, width) / total;
    away += centre[c] * centre[c];
  }
  double least = 1e-28 * away > 1e-120 ? 1e-28 * away : 1e-120;
  return spread > least ? sqrt(dim / spread) : 1;
}

/* The coordinates (dim, width) of a slot's matches, 0 behind the last one. */
static void gather(const Slot *s, const double *x, ptrdiff_t n, ptrdiff_t width, double *columns) {
  for (int c = 0; c < s->dim; c++) {
    for (ptrdiff_t k = 0; k < n; k++) columns[c * width + k] = x[k * s->match + c * s->coordinate];
    for (ptrdiff_t k = n; k < width; k++) columns[c * width + k] = 0;
  }
}

/* Upper triangles of the outer products of the slot's vectors of some matches, component first: out[row out_stride + k]; matches at
   x[c stride + k]. */
static void pack_slot(const Slot *s, const double *x, ptrdiff_t stride, int width, double scale_, const double *centre,
                      const double *weights, double *out, ptrdiff_t out_stride) {
  double moved[MAX_SPACE + 1][CHUNK + 8];
  int d = s->dim, row = 0;
  for (int c = 0; c < d; c++) for (int k = 0; k < width; k++) moved[c][k] = (x[c * stride + k] - centre[c]) * scale_;
  for (int k = 0; k < width; k++) moved[d][k] = 1;
  if (s->kind == CONIC_MONOMIALS) {  /* of the point (x, y, 1), each scaled by the root of how often it occurs */
    double factor = 1.4142135623730951, mono[6];
    for (int k = 0; k < width; k++) {
      double a = moved[0][k], b = moved[1][k];
      mono[0] = a * a; mono[1] = factor * a * b; mono[2] = factor * a; mono[3] = b * b; mono[4] = factor * b; mono[5] = 1;
      for (int i = 0, r = 0; i < 6; i++) for (int j = i; j < 6; j++, r++) out[r * out_stride + k] = mono[i] * mono[j];
    }
    row = 21;
  } else if (s->kind == POINT || s->kind == VECTORS) {
    int columns = slot_width(s);
    for (int i = 0; i < columns; i++) for (int j = i; j < columns; j++, row++)
      for (int k = 0; k < width; k++) out[row * out_stride + k] = moved[i][k] * moved[j][k];
  } else {  /* the rows of [I | -x] */
    for (int i = 0; i <= d; i++) for (int j = i; j <= d; j++, row++) {
      double *entry = out + row * out_stride;
      if (j < d) for (int k = 0; k < width; k++) entry[k] = i == j;
      else if (i < d) for (int k = 0; k < width; k++) entry[k] = -moved[i][k];
      else for (int k = 0; k < width; k++) {
        double sum = 0;
        for (int c = 0; c < d; c++) sum += moved[c][k] * moved[c][k];
        entry[k] = sum;
      }
    }
  }
  if (weights) for (int r = 0; r < row; r++) for (int k = 0; k < width; k++) out[r * out_stride + k] *= weights[k];
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

/* The vectors of one measurement, coordinates at x[c stride]: how many. */
static int slot_vectors(const Slot *s, const double *x, ptrdiff_t stride, double scale_, const double *centre, double out[][MAX_SPACE + 1]) {
  double factor = 1.4142135623730951, moved[MAX_SPACE + 1];
  int d = s->dim;
  for (int c = 0; c < d; c++) moved[c] = (x[c * stride] - centre[c]) * scale_;
  moved[d] = 1;
  if (s->kind == CONIC_MONOMIALS) {
    double a = moved[0], b = moved[1], mono[6] = {a * a, factor * a * b, factor * a, b * b, factor * b, 1};
    memcpy(out[0], mono, sizeof mono);
  } else if (s->kind == HYPERPLANES_THROUGH) {
    for (int e = 0; e < d; e++) for (int c = 0; c <= d; c++) out[e][c] = c < d ? c == e : -moved[e];
    return d;
  } else memcpy(out[0], moved, sizeof(double) * slot_width(s));
  return 1;
}

/* The rows of match k, (rows, D): products of the vectors of its slots, columns (dim, stride) each; how many. */
static int product_rows(const Slot *slots, int count, const double *const *columns, ptrdiff_t stride, ptrdiff_t k, const double *scales,
                        const double *centres, double factor, double *out) {
  double vectors[MAX_SPACE][MAX_SPACE + 1];
  int rows = 1, width = 1;
  out[0] = factor;
  for (int s = 0; s < count; s++) {
    int w = slot_width(slots + s), more = slot_vectors(slots + s, columns[s] + k, stride, scales[s], centres + s * MAX_SPACE, vectors);
    for (int r = rows - 1; r >= 0; r--) for (int e = more - 1; e >= 0; e--)  /* from the end: in place */
      for (int i = width - 1; i >= 0; i--) for (int c = w - 1; c >= 0; c--)
        out[((r * more + e) * width + i) * w + c] = out[r * width + i] * vectors[e][c];
    rows *= more;
    width *= w;
  }
  return rows;
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

/* ---- judgement and the way back to measured coordinates ----------------------------------------------------------------- */

enum { RESOLVED, GRAM_ROUNDING, CONDITION, NOISE, NARROW_WIDTH, SPARE_ROWS, CHANCE_FACTOR, CHANCE_QUANTILE };  /* limits: see fit.py */
enum { OK = 0, DEGENERATE = 2, AMBIGUOUS = 3 };  /* dyntorch.Status */
enum { UNDECIDED = 1, WEAK = 2, EXACT = 4 };  /* left to the caller; the noise is to be read off; the rows are to correct (inside) */
enum { ANY_TENSOR, RANK_TWO, NONSINGULAR, HOMOGRAPHIES };  /* internal constraints */

typedef struct { double residual, sum, trace, next; int certified; } Spectrum;

/* The status of one problem, and the expected relative error: the rules of _relative_noise and _ambiguity_limit in fit.py. */
static int judge(const Spectrum *found, const double *limits, double present, int few, int width, int dim, int *status, double *error) {
  double spare = present - (width - dim);
  spare = spare > 0 ? spare : 0;
  double noise = (found->residual > 0 ? found->residual : 0) / (spare > 1 ? spare : 1);
  double square = spare > 0 ? noise * found->sum : 0, condition = found->trace * found->sum, rounding = EPS * condition;
  *error = sqrt(square);
  *status = OK;
  int exact = rounding > limits[GRAM_ROUNDING] && rounding > 1e-3 * square;
  if (!found->certified || !(found->next > limits[RESOLVED]) || few || present < width - dim) return UNDECIDED;
  double limit = limits[NOISE];
  if (width <= limits[NARROW_WIDTH] && spare >= limits[SPARE_ROWS]) {  /* chi-square over its mean (Wilson and Hilferty) */
    double part = 2 / (9 * spare), cube = 1 - part + limits[CHANCE_QUANTILE] * sqrt(part);
    cube *= limits[CHANCE_FACTOR] * cube * cube;
    limit = cube < limit ? cube : limit;
  }
  int flags = exact ? EXACT : 0;
  if (square * (present > 1 ? present : 1) > limit) { *status = AMBIGUOUS; return flags; }
  return spare > 0 && condition > limits[CONDITION] ? flags | WEAK : flags;
}

static double largest(const double *x, int size) {
  double most = 0;
  for (int i = 0; i < size; i++) most = fabs(x[i]) > most ? fabs(x[i]) : most;
  return most;
}
static void divide(double *x, double by, int size) { if (by > 0) for (int i = 0; i < size; i++) x[i] /= by; }
static void unit_length(double *x, int size) {
  double total = 0;
  for (int i = 0; i < size; i++) total += x[i] * x[i];
  divide(x, sqrt(total), size);
}
static void cofactors(const double *M, double *out) {
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
    out[3 * i + j] = M[3 * a + c] * M[3 * b + d] - M[3 * a + d] * M[3 * b + c];
  }
}

/* Left and right null vector of a 3 x 3 matrix, as null_vectors in geometry/homogeneous.py. */
static void null_vectors(const double *M, double *left, double *right) {
  double scaled[9], adjoint[9], power[9], next[9];
  memcpy(scaled, M, sizeof scaled);
  divide(scaled, largest(scaled, 9), 9);
  cofactors(scaled, adjoint);
  divide(adjoint, largest(adjoint, 9), 9);
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    power[3 * i + j] = 0;
    for (int k = 0; k < 3; k++) power[3 * i + j] += adjoint[3 * i + k] * adjoint[3 * j + k];
  }
  for (int squaring = 0; squaring < 5; squaring++) {
    divide(power, largest(power, 9), 9);
    for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
      next[3 * i + j] = 0;
      for (int k = 0; k < 3; k++) next[3 * i + j] += power[3 * i + k] * power[3 * k + j];
    }
    memcpy(power, next, sizeof power);
  }
  int pick = 0;
  for (int i = 1; i < 3; i++) if (power[4 * i] > power[4 * pick]) pick = i;
  for (int i = 0; i < 3; i++) left[i] = power[3 * i + pick];
  divide(left, largest(left, 3), 3);
  unit_length(left, 3);
  for (int i = 0; i < 3; i++) right[i] = adjoint[i] * left[0] + adjoint[3 + i] * left[1] + adjoint[6 + i] * left[2];
  unit_length(right, 3);
}

/* matrix (batch, 3, 3) -> left and right null vectors (batch, 3). */
int EXPORT(null_vectors)(const double *matrix, ptrdiff_t batch, double *left, double *right) {
  for (ptrdiff_t p = 0; p < batch; p++) null_vectors(matrix + 9 * p, left + 3 * p, right + 3 * p);
  return 0;
}

/* Determinant by elimination with pivots; destroys the matrix. */
static double determinant(double *M, int size) {
  double det = 1;
  for (int j = 0; j < size; j++) {
    int pivot = j;
    for (int i = j + 1; i < size; i++) if (fabs(M[i * size + j]) > fabs(M[pivot * size + j])) pivot = i;
    if (!(fabs(M[pivot * size + j]) > 0)) return 0;
    if (pivot != j) {
      for (int k = 0; k < size; k++) { double t = M[j * size + k]; M[j * size + k] = M[pivot * size + k]; M[pivot * size + k] = t; }
      det = -det;
    }
    det *= M[j * size + j];
    for (int i = j + 1; i < size; i++) {
      double factor = M[i * size + j] / M[j * size + j];
      for (int k = j + 1; k < size; k++) M[i * size + k] -= factor * M[j * size + k];
    }
  }
  return det;
}

/* The nearest tensor that fulfils the internal constraints, 0 where there is none; tensors of norm 1. */
static void constrain(double *tensor, int constraint, int width) {
  if (constraint == RANK_TWO) {
    double left[3], right[3];
    null_vectors(tensor, left, right);
    for (int i = 0; i < 3; i++) {
      double along = tensor[3 * i] * right[0] + tensor[3 * i + 1] * right[1] + tensor[3 * i + 2] * right[2];
      for (int j = 0; j < 3; j++) tensor[3 * i + j] -= along * right[j];
    }
  } else if (constraint == NONSINGULAR) {
    double copy[(MAX_SPACE + 1) * (MAX_SPACE + 1)];
    memcpy(copy, tensor, sizeof(double) * width * width);
    if (fabs(determinant(copy, width)) <= 1e-12) memset(tensor, 0, sizeof(double) * width * width);
  }
}

/* The tensor of the measured coordinates at norm 1; whether there is one. */
static int denormalize(const Slot *slots, int count, const double *scales, const double *centres, double *tensor, int D) {
  int inner = D;
  for (int s = 0; s < count; s++) {
    int d = slots[s].dim, dual = slots[s].kind == HYPERPLANES_THROUGH;
    const double *c = centres + s * MAX_SPACE;
    double factor = dual ? 1 / scales[s] : scales[s], away = (dual ? 1 : factor) * largest(c, d);
    double most = factor > 1 ? factor : 1;
    most = away > most ? away : most;
    inner /= d + 1;
    for (int outer = 0; outer < D; outer += inner * (d + 1)) for (int k = 0; k < inner; k++) {
      double *entry = tensor + outer + k, *last = entry + d * inner, sum = *last;
      for (int i = 0; i < d; i++) {
        if (dual) entry[i * inner] = (entry[i * inner] * factor + *last * c[i]) / most;
        else { sum -= factor * c[i] * entry[i * inner]; entry[i * inner] *= factor / most; }
      }
      *last = sum / most;
    }
  }
  double most = largest(tensor, D);
  divide(tensor, most, D);
  unit_length(tensor, D);
  return most > 0 && most < 1.0 / 0.0;
}

static void write_similarity(const Slot *s, double scale_, const double *centre, double *out) {
  int d = s->dim;
  for (int i = 0; i <= d; i++) for (int j = 0; j <= d; j++) out[i * (d + 1) + j] = i == j ? (i < d ? scale_ : 1) : 0;
  for (int i = 0; i < d; i++) out[i * (d + 1) + d] = -scale_ * centre[i];
}

/* Weights over the largest one, 0 behind the last; how many are positive, and their sum. */
static int relative_weights(const double *weights, ptrdiff_t n, ptrdiff_t width, double *relative, double *total) {
  lanes most = all(2.2250738585072014e-308), sum = all(0), present = all(0);
  memcpy(relative, weights, sizeof(double) * n);
  for (ptrdiff_t k = n; k < width; k++) relative[k] = 0;
  for (ptrdiff_t k = 0; k < width; k += LANES) most = larger(*(const unaligned_lanes *)(relative + k), most);
  double top = most[0], count = 0;
  for (int v = 1; v < LANES; v++) top = most[v] > top ? most[v] : top;
  for (ptrdiff_t k = 0; k < width; k += LANES) {
    lanes share = *(const unaligned_lanes *)(relative + k) / top;
    *(unaligned_lanes *)(relative + k) = share;
    sum += share;
    present += where(share > all(0), all(1), all(0));
  }
  *total = 0;
  for (int v = 0; v < LANES; v++) { *total += sum[v]; count += present[v]; }
  *total = *total > 2.2250738585072014e-308 ? *total : 2.2250738585072014e-308;
  return (int)count;
}

/* The null spaces of lanes whose Gram has lost the digits that their noise would need, corrected by the rows; 0: these are too many,
   or there is no memory for them. */
static int correct_exact(Pack *p, const Slot *slots, int count, ptrdiff_t first, ptrdiff_t n, ptrdiff_t padded, const double *weights,
                         double (*scales)[MAX_SLOTS], double (*centres)[MAX_SLOTS * MAX_SPACE], const int *flags, int lanes_used,
                         double *relative, double *columns) {
  int D = p->D, lines = 1, exact = 0;
  const double *A[LANES] = {NULL}, *of_slot[MAX_SLOTS];
  mask wanted = all(0) != all(0);
  for (int s = 0; s < count; s++) lines *= slots[s].kind == HYPERPLANES_THROUGH ? slots[s].dim : 1;
  for (int v = 0; v < lanes_used; v++) if (flags[v] & EXACT) { wanted[v] = -1; exact++; }
  ptrdiff_t size = n * lines * D;
  double total, *memory = size > MAX_ROWS ? NULL : malloc(sizeof(double) * (exact * size + (2 * (size_t)p->dim + 1) * D + MAX_DIM));
  if (!memory) return 0;
  double *next = memory;
  for (int v = 0; v < lanes_used; v++) if (wanted[v]) {
    double *place = columns;
    relative_weights(weights + (first + v) * n, n, padded, relative, &total);
    for (int s = 0; s < count; s++) {
      gather(slots + s, slots[s].x + (first + v) * slots[s].batch, n, padded, place);
      of_slot[s] = place;
      place += slots[s].dim * padded;
    }
    A[v] = next;
    for (ptrdiff_t k = 0; k < n; k++, next += lines * D)
      product_rows(slots, count, of_slot, padded, k, scales[v], centres[v], sqrt(relative[k]), next);
  }
  correct_by_rows(p, A, n * lines, wanted, next);
  free(memory);
  return 1;
}

typedef struct {
  double *const *transforms;  /* (batch, d + 1, d + 1) of each slot */
  double *basis, *second;     /* (batch, dim, D) null space, (batch, D) vector of the next eigenvalue where WEAK */
  double *normalized, *tensor;  /* (batch, D) with its constraint, and in measured coordinates; NULL: not wanted */
  double *error;              /* (batch) expected relative error */
  long long *status;          /* (batch) */
  unsigned char *flags;       /* (batch) */
} Fits;

/* Fits of a batch: slots described by kinds, dims, pointers and strides (3 each), weights (batch, n), rows per match, fewest
   matches and limits of the judgement -> out.  0, or 1 without memory. */
int EXPORT(fit_points)(int slots, const int *kinds, const int *dims, const double *const *views, const ptrdiff_t *strides,
                       const double *weights, ptrdiff_t batch, ptrdiff_t n, int dim, int normalized, int rows, int minimal,
                       int constraint, const double *limits, double *const *transforms, double *basis, double *second,
                       double *constrained, double *tensor, double *error, long long *status, unsigned char *flags) {
  Fits out = {transforms, basis, second, constrained, tensor, error, status, flags};
  Slot slot[MAX_SLOTS];
  ptrdiff_t padded = (n + LANES - 1) / LANES * LANES;
  int sizes[MAX_SLOTS], D = 1, all_packed = 0, chunk = padded < CHUNK ? (int)padded : CHUNK, coordinates = 0;
  size_t moments_size = 1;
  for (int s = 0; s < slots; s++) {
    slot[s] = (Slot){kinds[s], dims[s], views[s], strides[3 * s], strides[3 * s + 1], strides[3 * s + 2]};
    sizes[s] = packed_size(slot + s);
    D *= slot_width(slot + s);
    all_packed += sizes[s];
    coordinates += slot[s].dim;
    moments_size *= sizes[s];
  }
  Pack p;
  double *generic, *rest;
  size_t packed_room = (size_t)all_packed * chunk, room_size = (WIDE + 1) * (size_t)chunk + LANES;
  lanes *memory = workspace(&p, D, dim, moments_size * LANES + packed_room + room_size + (1 + coordinates) * padded, &generic, &rest);
  int *index = malloc(sizeof(int) * D * D);
  if (!memory || !index) { free(memory); free(index); return 1; }
  double *moments = rest, *packed[MAX_SLOTS], *room;
  packed[0] = moments + moments_size * LANES;
  for (int s = 1; s < slots; s++) packed[s] = packed[s - 1] + (size_t)sizes[s - 1] * chunk;
  room = packed[slots - 1] + (size_t)sizes[slots - 1] * chunk;
  double *relative = room + room_size, *columns = relative + padded;
  unpacking(slot, slots, D, index);
  for (ptrdiff_t first = 0; first < batch; first += LANES) {
    int count = batch - first < LANES ? (int)(batch - first) : LANES, present[LANES];
    double scales[LANES][MAX_SLOTS], centres[LANES][MAX_SLOTS * MAX_SPACE];
    memset(moments, 0, sizeof(double) * moments_size * LANES);
    for (int v = 0; v < count; v++) {
      const double *of_slot[MAX_SLOTS];
      double *free_column = columns, total;
      present[v] = relative_weights(weights + (first + v) * n, n, padded, relative, &total);
      for (int s = 0; s < slots; s++) {
        double *centre = centres[v] + s * MAX_SPACE;
        int d = slot[s].dim, size = (d + 1) * (d + 1);
        for (int c = 0; c < MAX_SPACE; c++) centre[c] = 0;
        gather(slot + s, slot[s].x + (first + v) * slot[s].batch, n, padded, free_column);
        scales[v][s] = normalized ? similarity(free_column, d, relative, total, padded, centre) : 1;
        if (slot[s].kind != VECTORS) write_similarity(slot + s, scales[v][s], centre, out.transforms[s] + (first + v) * size);
        of_slot[s] = free_column;
        free_column += d * padded;
      }
      for (ptrdiff_t start = 0; start < padded; start += chunk) {
        int width = padded - start < chunk ? (int)(padded - start) : chunk;
        for (int s = 0; s < slots; s++)
          pack_slot(slot + s, of_slot[s] + start, padded, width, scales[v][s], centres[v] + s * MAX_SPACE,
                    s == 0 ? relative + start : NULL, packed[s], width);
        add_moments(packed, sizes, slots, width, moments + v, LANES, room);
      }
    }
    for (int v = count; v < LANES; v++) for (size_t k = 0; k < moments_size; k++) moments[k * LANES + v] = moments[k * LANES + count - 1];
    for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) p.G[i * D + j] = *(const lanes *)(moments + (ptrdiff_t)index[i * D + j] * LANES);
    lanes trace = all(0);
    for (int i = 0; i < D; i++) trace += p.G[i * D + i];
    null_spaces(&p, generic, 1);
    double values[LANES * MAX_DIM], sums[LANES], next[LANES];
    unsigned char certified[LANES];
    Answers answers = {out.basis + first * dim * D, values, sums, next, certified};
    write_answers(&p, &answers, 0, count, generic);
    int flags_[LANES], state[LANES], together = 0;
    for (int v = 0; v < count; v++) {
      Spectrum found = {0, sums[v], trace[v], next[v], certified[v]};
      for (int j = 0; j < dim; j++) found.residual += values[v * dim + j] / dim;
      flags_[v] = judge(&found, limits, (double)present[v] * rows, present[v] < minimal, D, dim, state + v, out.error + first + v);
      together |= flags_[v];
    }
    if (together & EXACT) {
      int corrected = correct_exact(&p, slot, slots, first, n, padded, weights, scales, centres, flags_, count, relative, columns);
      for (int v = 0; v < count; v++) if (flags_[v] & EXACT) flags_[v] = corrected ? flags_[v] & ~EXACT : UNDECIDED;
      write_answers(&p, &answers, 0, count, generic);
    }
    for (int v = 0; v < count; v++) {
      ptrdiff_t problem = first + v;
      int flag = flags_[v];
      if (out.tensor && flag != UNDECIDED) {
        double *one = out.normalized + problem * D, *back = out.tensor + problem * D;
        memcpy(one, out.basis + problem * D, sizeof(double) * D);
        constrain(one, constraint, slot[0].dim + 1);
        memcpy(back, one, sizeof(double) * D);
        if (!denormalize(slot, slots, scales[v], centres[v], back, D)) {
          state[v] = DEGENERATE;
          memset(one, 0, sizeof(double) * D);
          memset(back, 0, sizeof(double) * D);
        }
      }
      out.status[problem] = state[v];
      out.flags[problem] = flag;
    }
    if (together & WEAK) {
      next_vector(&p);
      for (int v = 0; v < count; v++) for (int i = 0; i < D; i++) out.second[(first + v) * D + i] = p.block[dim * D + i][v];
    }
  }
  free(memory);
  free(index);
  return 0;
}
