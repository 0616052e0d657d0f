/* Fits: matches -> similarities -> moments of products of slots -> null spaces, in one pass. */

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
