/* Robust search: minimal samples, annealed reweighting, truncated scores and the evidence that a find beats chance, for forms of
   one tensor; the mathematics is that of dyntorch/core/consensus.py, which also says what the constants are. */

static const double SHIFT_EPSILON = 1e-14, HUGE_SQUARE = 1e30, SINGULAR_SLOPE = 1e-14;
enum {  /* rules */
  SHRINKING_SHARE, NUM_CONCENTRATIONS, NUM_SHUFFLES, MAX_NEAR_MISSES, MIN_STARTS_TO_COMPARE, SAME_SCORE, GUIDED_REWEIGHTINGS,
  STARTS_PER_UNGUIDED
};
enum { FROM_ALL, FROM_SAMPLES, FROM_SUBSETS, LEAST_MEDIAN, AS_GIVEN };
enum { ANNEALED, GUIDED, WITHIN };   /* reweighted to the limit, with motions as guides, or to the matches within it */
enum { MAX_SAMPLE = 8, FIRST_ITERATIONS = 3, SUBSET_ITERATIONS = 6, MAX_FORM = 64 };

typedef struct {
  const Slot *slots;
  const double *rules;                /* of the search, see consensus.py */
  int count, D, transfer;             /* slot that the others predict, or -1: the value of a form */
  ptrdiff_t n, padded;
  const double *columns[MAX_SLOTS];   /* (dim, padded) of each slot, normalized */
  double scales[MAX_SLOTS];
  const double *weights;              /* (padded), 0 behind the last */
  double *packed[MAX_SLOTS];          /* (size, padded) outer products of the vectors */
  int sizes[MAX_SLOTS];
  double *weighted, *room;            /* (sizes[0], padded), and room of add_moments */
  double *square, *rows, *omega;      /* (padded) squared distances, weights of rows, weights of matches */
  double *lengths;                    /* (padded) squared length of the rows of each match */
  double *moments;                    /* (product of sizes, LANES) */
  const int *index;
  lanes *G, *f, *start;               /* (D, D), (D), (D) */
} Bundle;

#define AT(x, k) (*(const unaligned_lanes *)((x) + (k)))
#define PUT(x, k) (*(unaligned_lanes *)((x) + (k)))

/* A form of two or three points at LANES matches: its value, and its derivatives by the vectors of all slots; `count` slots of
   so many columns, which the callers below know when they are compiled. */
static inline __attribute__((always_inline)) lanes form_of(const double *f, const double *const *columns, ptrdiff_t padded, ptrdiff_t k,
                                                           int count, int w0, int w1, int w2, lanes slopes[][MAX_SPACE + 1]) {
  lanes u0[MAX_SPACE + 1], u1[MAX_SPACE + 1], u2[MAX_SPACE + 1], value = all(0);
  for (int c = 0; c < w0; c++) { u0[c] = c + 1 < w0 ? AT(columns[0] + c * padded, k) : all(1); slopes[0][c] = all(0); }
  for (int c = 0; c < w1; c++) { u1[c] = c + 1 < w1 ? AT(columns[1] + c * padded, k) : all(1); slopes[1][c] = all(0); }
  if (count > 2) for (int c = 0; c < w2; c++) { u2[c] = c + 1 < w2 ? AT(columns[2] + c * padded, k) : all(1); slopes[2][c] = all(0); }
  for (int i = 0; i < w0; i++) for (int j = 0; j < w1; j++) {
    const double *entry = f + (i * w1 + j) * (count > 2 ? w2 : 1);
    lanes part = all(entry[0]);
    if (count > 2) {
      lanes product = u0[i] * u1[j];
      part = all(0);
      for (int l = 0; l < w2; l++) { part += entry[l] * u2[l]; slopes[2][l] += entry[l] * product; }
    }
    slopes[0][i] += part * u1[j];
    slopes[1][j] += part * u0[i];
  }
  for (int i = 0; i < w0; i++) value += slopes[0][i] * u0[i];
  return value;
}
/* Where a point of the other slot is predicted, and how that varies with it: place (d), slopes (d, d), depth. */
static inline __attribute__((always_inline)) lanes predict(const double *f, const double *point, ptrdiff_t padded, ptrdiff_t k, int d,
                                                           int row, int column, lanes *place, lanes slopes[][3]) {
  lanes y[4], most = all(0);
  for (int i = 0; i <= d; i++) {
    y[i] = all(f[i * row + d * column]);
    for (int c = 0; c < d; c++) y[i] += f[i * row + c * column] * AT(point + c * padded, k);
    most = larger(absolute(y[i]), most);
  }
  lanes floor_ = most * 1e-12, depth = where(absolute(y[d]) > floor_, y[d], larger(floor_, all(TINY))), by = all(1) / depth;
  for (int i = 0; i < d; i++) {
    place[i] = y[i] * by;
    for (int c = 0; c < d; c++) slopes[i][c] = (f[i * row + c * column] - place[i] * f[d * row + c * column]) * by;
  }
  return depth;
}

/* The squared distance of a predicted point in units of its covariance, and the weight of its rows. */
static inline __attribute__((always_inline)) lanes transfer_of(const Bundle *b, const double *f, const double *const *columns, ptrdiff_t k,
                                                               int slot, int d, lanes *row) {
  lanes place[3], slopes[3][3], factor[3][3], solved[3], trace = all(0), result = all(0);
  lanes depth = predict(f, columns[1 - slot], b->padded, k, d, slot ? 1 : d + 1, slot ? d + 1 : 1, place, slopes);
  double own = b->scales[slot] * b->scales[slot], other = b->scales[1 - slot] * b->scales[1 - slot];
  for (int i = 0; i < d; i++) {  /* Cholesky of the covariance, row by row */
    solved[i] = place[i] - AT(columns[slot] + i * b->padded, k);
    for (int j = 0; j <= i; j++) {
      lanes entry = all(i == j ? own : 0);
      for (int c = 0; c < d; c++) entry += other * slopes[i][c] * slopes[j][c];
      if (i == j) trace += entry;
      for (int l = 0; l < j; l++) entry -= factor[i][l] * factor[j][l];
      factor[i][j] = i == j ? all(1) / root(larger(entry, all(EPS * EPS))) : entry * factor[j][j];
    }
    for (int j = 0; j < i; j++) solved[i] -= factor[i][j] * solved[j];
    solved[i] *= factor[i][i];
    result += solved[i] * solved[i];
  }
  *row = all(1) / (trace * (1. / d) * depth * depth + SINGULAR_SLOPE);
  return result;
}

/* The squared distance of a form of points over the length of its gradient, and the weight of its row. */
static inline __attribute__((always_inline)) lanes form_distance(const Bundle *b, const double *f, const double *const *columns,
                                                                 ptrdiff_t k, int count, int d0, int d1, int d2, lanes *row) {
  lanes slopes[3][MAX_SPACE + 1], own[3] = {all(0), all(0), all(0)}, total = all(SINGULAR_SLOPE);
  lanes value = form_of(f, columns, b->padded, k, count, d0 + 1, d1 + 1, d2 + 1, slopes);
  for (int c = 0; c < d0; c++) own[0] += slopes[0][c] * slopes[0][c];
  for (int c = 0; c < d1; c++) own[1] += slopes[1][c] * slopes[1][c];
  for (int c = 0; count > 2 && c < d2; c++) own[2] += slopes[2][c] * slopes[2][c];
  for (int s = 0; s < count; s++) total += b->scales[s] * b->scales[s] * own[s];
  *row = all(1) / total;
  return value * value * *row;
}

/* Squared Sampson distances at LANES matches, no number where there is none, and the weights of their rows. */
static inline __attribute__((always_inline)) lanes distance_at(const Bundle *b, const double *f, const double *const *columns, ptrdiff_t k,
                                                               int slot, int d, lanes *row) {
  int d0 = b->slots[0].dim, d1 = b->slots[1].dim, d2 = b->count > 2 ? b->slots[2].dim : 0;
  if (slot == 0 && d == 2) return transfer_of(b, f, columns, k, 0, 2, row);
  if (slot >= 0) return transfer_of(b, f, columns, k, slot, d, row);
  if (b->count == 2 && d0 == 2 && d1 == 2) return form_distance(b, f, columns, k, 2, 2, 2, 0, row);
  return form_distance(b, f, columns, k, b->count, d0, d1, d2, row);
}

static void distances(const Bundle *b, const double *f, const double *const *columns, double *square, double *rows) {
  int slot = b->transfer, d = b->slots[slot < 0 ? 0 : slot].dim;
  for (ptrdiff_t k = 0; k < b->padded; k += LANES) {
    lanes row, result = distance_at(b, f, columns, k, slot, d, &row);
    PUT(square, k) = where(result < all(HUGE_SQUARE), result, all(HUGE_SQUARE));  /* also where it is no number */
    PUT(rows, k) = where(row < all(1 / TINY), row, all(0));
  }
}

/* Truncated squares in units of the limit, summed over the matches; hasty: of matches in random order, until those seen lose three
   standard deviations (of a third each) more than their share of `most`. */
static double score_of(const Bundle *b, const double *f, const double *const *columns, const double *weights, double limit, double most,
                       int hasty) {
  int slot = b->transfer, d = b->slots[slot < 0 ? 0 : slot].dim;
  double total = 0, by = 1 / limit;
  for (ptrdiff_t start = 0; start < b->padded; start += 8 * LANES) {
    lanes row, sum = all(0);
    ptrdiff_t end = start + 8 * LANES < b->padded ? start + 8 * LANES : b->padded;
    for (ptrdiff_t k = start; k < end; k += LANES) {
      lanes share = distance_at(b, f, columns, k, slot, d, &row) * by;
      sum += where(share < all(1), share, all(1)) * AT(weights, k);
    }
    for (int v = 0; v < LANES; v++) total += sum[v];
    if (hasty && total > most * ((double)end / b->n) + sqrt((double)end)) return INFINITY;
  }
  return total;
}

static double median_of(double *x, ptrdiff_t count, ptrdiff_t place) {  /* reorders x */
  ptrdiff_t low = 0, high = count - 1;
  while (low < high) {
    double pivot = x[(low + high) / 2];
    ptrdiff_t i = low, j = high;
    while (i <= j) {
      while (x[i] < pivot) i++;
      while (x[j] > pivot) j--;
      if (i <= j) { double t = x[i]; x[i++] = x[j]; x[j--] = t; }
    }
    if (place <= j) high = j;
    else if (place >= i) low = i;
    else break;
  }
  return x[place];
}

/* Median of the squares of matches with weight, omega as room. */
static double middle_square(const Bundle *b) {
  ptrdiff_t count = 0;
  for (ptrdiff_t k = 0; k < b->n; k++) if (b->weights[k] > 0) b->omega[count++] = b->square[k];
  return count ? median_of(b->omega, count, count / 2) : HUGE_SQUARE;
}

/* Gram of the matches by the weights in omega, into one lane. */
static void add_gram(const Bundle *b, int lane, int size) {
  for (int k = 0; k < size; k++) b->moments[k * LANES + lane] = 0;
  for (int r = 0; r < b->sizes[0]; r++) for (ptrdiff_t k = 0; k < b->padded; k += LANES)
    PUT(b->weighted, r * b->padded + k) = AT(b->packed[0], r * b->padded + k) * AT(b->omega, k);
  double *packed[MAX_SLOTS];
  memcpy(packed, b->packed, sizeof packed);
  packed[0] = b->weighted;
  add_moments(packed, b->sizes, b->count, (int)b->padded, b->moments + lane, LANES, b->room);
}
/* Moments of `some` lanes -> Grams, the other lanes as the first. */
static void spread_moments(const Bundle *b, int some, int size) {
  for (int v = some; v < LANES; v++) for (int k = 0; k < size; k++) b->moments[k * LANES + v] = b->moments[k * LANES];
  for (int i = 0; i < b->D; i++) for (int j = 0; j <= i; j++)
    b->G[i * b->D + j] = *(const lanes *)(b->moments + (ptrdiff_t)b->index[i * b->D + j] * LANES);
}

/* Null vectors f of the Grams G by inverse iteration; those that are no numbers stay. */
static void iterate(const Bundle *b, int iterations) {
  int D = b->D;
  lanes trace = all(0);
  memcpy(b->start, b->f, sizeof(lanes) * D);
  for (int i = 0; i < D; i++) trace += b->G[i * D + i];
  for (int i = 0; i < D; i++) b->G[i * D + i] += trace * SHIFT_EPSILON + TINY;
  mask good = cholesky(b->G, D);
  for (int k = 0; k < iterations; k++) { solve(b->G, D, b->f); normalize(b->f, D); }
  for (int i = 0; i < D; i++) good &= absolute(b->f[i]) <= all(2);
  for (int i = 0; i < D; i++) b->f[i] = where(good, b->f[i], b->start[i]);
}

/* Reweighted fits of `count` tensors (count, D), LANES at a time, in one of the three ways; limit 0: to the median of the squares.  Guided: distances are those of the motions
   of homography tensors, and the gradients of a wrong tensor, which mislead, have half their say at first. */
static void reweight(const Bundle *b, double *tensors, int count, double limit, int iterations, int how, int moments_size) {
  for (int first = 0; first < count; first += LANES) {
    int some = count - first < LANES ? count - first : LANES;
    double start[LANES], one[MAX_FORM];
    lanes guides[MAX_ENTRIES], partners[MAX_PARAMETERS];
    generic_partners(partners);
    for (int v = 0; v < LANES; v++) for (int i = 0; i < b->D; i++) b->f[i][v] = tensors[(first + (v < some ? v : 0)) * b->D + i];
    for (int iteration = 0; iteration < iterations; iteration++) {
      double share = iteration / (b->rules[SHRINKING_SHARE] * iterations);
      const lanes *from = how == GUIDED && share < 1 ? guides : b->f;
      int tamed = how == GUIDED && 2 * iteration < iterations;
      if (from == guides) nearest_of_motions(b->f, iteration ? NEXT_ITERATIONS_OF_MOTION : FIRST_ITERATIONS_OF_MOTION, partners, guides);
      for (int v = 0; v < some; v++) {
        for (int i = 0; i < b->D; i++) one[i] = from[i][v];
        distances(b, one, b->columns, b->square, b->rows);
        if (!(limit > 0)) start[v] = larger(all(middle_square(b)), all(TINY))[0];
        else if (!iteration && how != WITHIN) { start[v] = 4 * middle_square(b); start[v] = start[v] > limit ? start[v] : limit; }
        lanes scale_ = all(!(limit > 0) ? start[v] : how == WITHIN ? limit : start[v] * pow(limit / start[v], share < 1 ? share : 1));
        for (ptrdiff_t k = 0; k < b->padded; k += LANES) {
          lanes square = AT(b->square, k), part = scale_ / (scale_ + square), row = AT(b->rows, k);
          part = how == WITHIN ? where(square <= scale_, all(1), all(0)) : part * part;
          if (tamed) row = root(row / AT(b->lengths, k));
          PUT(b->omega, k) = part * AT(b->weights, k) * row;
        }
        add_gram(b, v, moments_size);
      }
      spread_moments(b, some, moments_size);
      iterate(b, 2);
    }
    for (int v = 0; v < some; v++) for (int i = 0; i < b->D; i++) tensors[(first + v) * b->D + i] = b->f[i][v];
  }
}

static unsigned long long scramble(unsigned long long x) {  /* splitmix64 */
  x += 0x9e3779b97f4a7c15ULL;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

/* Squared lengths of the rows of all matches. */
static void measure_lengths(const Bundle *b) {
  for (ptrdiff_t k = 0; k < b->padded; k += LANES) {
    lanes length = all(1);
    for (int s = 0; s < b->count; s++) if (b->slots[s].kind == POINT) {
      lanes own = all(1);
      for (int c = 0; c < b->slots[s].dim; c++) { lanes x = AT(b->columns[s], c * b->padded + k); own += x * x; }
      length *= own;
    }
    PUT(b->lengths, k) = length;
  }
}

/* The null vectors of the Grams of `some` lanes of moments. */
static void first_of_moments(const Bundle *b, int some, int iterations, int moments_size, const double *generic, double *tensors) {
  spread_moments(b, some, moments_size);
  for (int i = 0; i < b->D; i++) b->f[i] = all(generic[i]);
  iterate(b, iterations);
  for (int v = 0; v < some; v++) for (int i = 0; i < b->D; i++) tensors[v * b->D + i] = b->f[i][v];
}

/* The null vector of all matches, each of its rows at length 1. */
static void first_of_all(const Bundle *b, int moments_size, const double *generic, double *tensor) {
  for (ptrdiff_t k = 0; k < b->padded; k += LANES) PUT(b->omega, k) = AT(b->weights, k) / AT(b->lengths, k);
  add_gram(b, 0, moments_size);
  first_of_moments(b, 1, FIRST_ITERATIONS, moments_size, generic, tensor);
}

/* The null vectors (count, D) of random subsets of `size` present matches, each of their rows at length 1.  0 without memory. */
static int subsets(const Bundle *b, int count, int size, unsigned long long seed, int moments_size, const double *generic, double *tensors) {
  ptrdiff_t *order = malloc(sizeof *order * (b->n + 1)), present = 0;
  if (!order) return 0;
  for (ptrdiff_t k = 0; k < b->n; k++) if (b->weights[k] > 0) order[present++] = k;
  for (int first = 0; first < count; first += LANES) {
    int some = count - first < LANES ? count - first : LANES;
    for (int v = 0; v < some; v++) {
      for (ptrdiff_t k = 0; k < b->padded; k++) b->omega[k] = 0;
      for (ptrdiff_t m = 0; m < size && m < present; m++) {
        seed = scramble(seed);
        ptrdiff_t other = m + (ptrdiff_t)((double)(seed >> 11) * 0x1p-53 * (present - m)), k = order[other];
        order[other] = order[m];
        order[m] = k;
        b->omega[k] = 1 / b->lengths[k];
      }
      add_gram(b, v, moments_size);
    }
    first_of_moments(b, some, SUBSET_ITERATIONS, moments_size, generic, tensors + first * b->D);
  }
  free(order);
  return 1;
}

/* The least median of squares: from all matches and from `starts` subsets, with motions as guides, then of the nearer halves;
   tensors: room (starts + 1, D).  -1 without memory. */
static double least_median(const Bundle *b, int starts, int size, unsigned long long seed, int iterations, int moments_size,
                           const double *generic, double *tensors) {
  double least = INFINITY;
  first_of_all(b, moments_size, generic, tensors);
  if (!subsets(b, starts, size, seed, moments_size, generic, tensors + b->D)) return -1;
  reweight(b, tensors, starts + 1, 0, iterations, GUIDED, moments_size);
  reweight(b, tensors, starts + 1, 0, (int)b->rules[NUM_CONCENTRATIONS], WITHIN, moments_size);
  for (int i = 0; i <= starts; i++) {
    distances(b, tensors + i * b->D, b->columns, b->square, b->rows);
    double middle = middle_square(b);
    least = middle < least ? middle : least;
  }
  return least;
}

static ptrdiff_t common_divisor(ptrdiff_t x, ptrdiff_t y) {
  while (y) { ptrdiff_t t = x % y; x = y; y = t; }
  return x;
}

/* The matches in an order without pattern: columns (coordinates, padded) and weights (padded). */
static void mix(const Bundle *b, double *columns, double *weights, const double **of_slot) {
  ptrdiff_t step = (ptrdiff_t)(b->n * .6180339887498949) + 1;
  while (common_divisor(step, b->n) > 1) step++;
  double *place = columns;
  for (int s = 0; s < b->count; s++) {
    of_slot[s] = place;
    for (int c = 0; c < b->slots[s].dim; c++, place += b->padded)
      for (ptrdiff_t k = 0, from = 0; k < b->padded; k++, from = (from + step) % b->n)
        place[k] = k < b->n ? b->columns[s][c * b->padded + from] : 0;
  }
  for (ptrdiff_t k = 0, from = 0; k < b->padded; k++, from = (from + step) % b->n) weights[k] = k < b->n ? b->weights[from] : 0;
}

/* Grams of LANES samples of `size` of the present matches, their rows (present, lines, D) at length 1. */
static unsigned long long sample(const Bundle *b, const double *rows, int lines, ptrdiff_t present, int size, unsigned long long seed) {
  int D = b->D;
  ptrdiff_t chosen[LANES][MAX_SAMPLE];
  for (int v = 0; v < LANES; v++) for (int m = 0; m < size;) {
    seed = scramble(seed);
    chosen[v][m] = (ptrdiff_t)((double)(seed >> 11) * 0x1p-53 * present);
    int again = 0;
    for (int l = 0; l < m; l++) again |= chosen[v][l] == chosen[v][m];
    m += !again;
  }
  for (int i = 0; i < D * D; i++) b->G[i] = all(0);
  for (int m = 0; m < size; m++) for (int r = 0; r < lines; r++) {
    lanes row[MAX_FORM];
    for (int v = 0; v < LANES; v++) {
      const double *from = rows + (chosen[v][m] * lines + r) * D;
      for (int i = 0; i < D; i++) row[i][v] = from[i];
    }
    for (int i = 0; i < D; i++) for (int j = 0; j <= i; j++) b->G[i * D + j] += row[i] * row[j];
  }
  return seed;
}

/* The best `keep` tensors (keep, D) of `count` minimal samples; mixed: room (coordinates + 1, padded).  How many, or -1. */
static int sampled(const Bundle *b, int count, int size, int keep, unsigned long long seed, double limit, const double *generic,
                   double *mixed, double *weights, double *scores, double *tensors) {
  int D = b->D, have = 0, lines = 1;
  ptrdiff_t present = 0;
  for (int s = 0; s < b->count; s++) lines *= b->slots[s].kind == HYPERPLANES_THROUGH ? b->slots[s].dim : 1;
  const double scales[MAX_SLOTS] = {1, 1, 1, 1, 1, 1}, centres[MAX_SLOTS * MAX_SPACE] = {0};
  double *rows = malloc(sizeof(double) * (b->n * lines * D + 1)), one[MAX_FORM];
  const double *columns[MAX_SLOTS];
  if (!rows) return -1;
  for (ptrdiff_t k = 0; k < b->n; k++) if (b->weights[k] > 0)
    product_rows(b->slots, b->count, b->columns, b->padded, k, scales, centres, 1 / sqrt(b->lengths[k]), rows + present++ * lines * D);
  mix(b, mixed, weights, columns);
  size = size < present ? size : (int)present;
  for (int first = 0; first < count; first += LANES) {
    seed = sample(b, rows, lines, present, size, seed);
    for (int i = 0; i < D; i++) b->f[i] = all(generic[i]);
    iterate(b, FIRST_ITERATIONS);
    for (int v = 0; v < LANES && first + v < count; v++) {
      int at = have, full = have == keep;
      for (int i = 0; i < D; i++) one[i] = b->f[i][v];
      if (full) for (int k = at = 0; k < keep; k++) if (scores[k] > scores[at]) at = k;
      double score = score_of(b, one, columns, weights, limit, full ? scores[at] : 0, full);
      if (full && !(score < scores[at])) continue;
      have += !full;
      scores[at] = score;
      memcpy(tensors + at * D, one, sizeof(double) * D);
    }
  }
  free(rows);
  return have;
}

static double choose(double n, double k) { k = k < n ? k : n; return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1); }

/* The numbers of n matches, shifted by some of them around the end. */
static void roll(const Bundle *b, const double *x, ptrdiff_t by, double *out) {
  by %= b->n;
  memcpy(out + by, x, sizeof(double) * (b->n - by));
  memcpy(out, x + b->n - by, sizeof(double) * by);
  for (ptrdiff_t i = b->n; i < b->padded; i++) out[i] = 0;
}

/* Log of the expected number of such finds among random matches, and whether to search on; shifted: room (coordinates, padded). */
static double evidence(const Bundle *b, const double *tensor, double limit, double minimal, double *shifted, double *other, int *doubt) {
  double n = 0, k = 0, near = 0, hits = 0, trials = 0;
  for (ptrdiff_t i = 0; i < b->n; i++) if (b->weights[i] > 0) {
    n++;
    k += b->square[i] <= limit;
    near += b->square[i] > limit && b->square[i] <= 9 * limit;
  }
  ptrdiff_t last = 0;
  int shuffles = (int)b->rules[NUM_SHUFFLES];
  for (int j = 0; j < shuffles; j++) {
    ptrdiff_t step = (2 * j + 1) * b->n / (2 * shuffles * b->count);
    step = step > 1 ? step : 1;
    if (step == last) continue;
    last = step;
    const double *columns[MAX_SLOTS];
    double *place = shifted;
    for (int s = 0; s < b->count; s++) {
      columns[s] = place;
      for (int c = 0; c < b->slots[s].dim; c++, place += b->padded) roll(b, b->columns[s] + c * b->padded, s * step, place);
    }
    distances(b, tensor, columns, other, b->rows);
    for (int s = 0; s < b->count; s++) {  /* of what is rolled, weights are the last */
      roll(b, b->weights, s * step, b->omega);
      for (ptrdiff_t i = 0; i < b->padded; i++) other[i] = b->omega[i] > 0 ? other[i] : -1;
    }
    for (ptrdiff_t i = 0; i < b->n; i++) { trials += other[i] >= 0; hits += other[i] >= 0 && other[i] <= limit; }
  }
  double surplus = n - minimal > 1 ? n - minimal : 1, chance = (hits + 1) / (trials + 1);
  double found = log(surplus) + choose(n, k) + choose(k, minimal) + (k - minimal) * log(chance);
  *doubt = k <= minimal || found >= 0 || near > b->rules[MAX_NEAR_MISSES] * k;
  return k > minimal ? found : INFINITY;
}

/* Slots, widths and sizes of a bundle; the number of its coordinates. */
static int describe(Bundle *b, Slot *slot, int slots, const int *kinds, const int *dims, const double *const *views,
                    const ptrdiff_t *strides, ptrdiff_t n) {
  int coordinates = 0;
  *b = (Bundle){.slots = slot, .count = slots, .D = 1, .transfer = -1, .n = n, .padded = (n + LANES - 1) / LANES * LANES};
  for (int s = 0; s < slots; s++) {
    slot[s] = (Slot){kinds[s], dims[s], views[s], strides[3 * s], strides[3 * s + 1], strides[3 * s + 2]};
    b->D *= slot_width(slot + s);
    b->sizes[s] = packed_size(slot + s);
    coordinates += dims[s];
    if (kinds[s] == HYPERPLANES_THROUGH) b->transfer = s;
  }
  return coordinates;
}

/* The matches of one problem of the batch, into columns (coordinates, padded) and weight (padded). */
static void take(Bundle *b, ptrdiff_t problem, const double *weights, const double *scales, double *columns, double *weight) {
  if (weight) for (ptrdiff_t k = 0; k < b->padded; k++) weight[k] = k < b->n ? weights[problem * b->n + k] : 0;
  b->weights = weight;
  for (int s = 0; s < b->count; s++) {
    const Slot *slot = b->slots + s;
    gather(slot, slot->x + problem * slot->batch, b->n, b->padded, columns);
    b->columns[s] = columns;
    b->scales[s] = scales[problem * b->count + s];
    columns += slot->dim * b->padded;
  }
}

/* Sampson distances (batch, n) of normalized matches from tensors (batch, D).  0, or 1 without memory. */
int EXPORT(distances)(int slots, const int *kinds, const int *dims, const double *const *views, const ptrdiff_t *strides,
                      const double *scales, const double *tensors, ptrdiff_t batch, ptrdiff_t n, double *out) {
  Slot slot[MAX_SLOTS];
  Bundle b;
  int coordinates = describe(&b, slot, slots, kinds, dims, views, strides, n);
  double *memory = malloc(sizeof(double) * ((size_t)(coordinates + 2) * b.padded + 1));
  if (!memory) return 1;
  double *square = memory + (size_t)coordinates * b.padded, *rows = square + b.padded;
  for (ptrdiff_t p = 0; p < batch; p++) {
    take(&b, p, NULL, scales, memory, NULL);
    distances(&b, tensors + p * b.D, b.columns, square, rows);
    for (ptrdiff_t k = 0; k < n; k++) out[p * n + k] = sqrt(square[k]);
  }
  free(memory);
  return 0;
}

/* The search of a batch: normalized matches as in fit_points, weights (batch, n) of at most 1, scales (batch, slots), limits of the
   squared distance (batch), seeds (batch); `mode` FROM_ALL weighs all matches alike, FROM_SAMPLES anneals the best `keep` of
   `starts` minimal samples, FROM_SUBSETS all of `starts` subsets of 2.5 times that size, most with motions as guides, LEAST_MEDIAN
   has only the score, AS_GIVEN judges the tensors in `basis` -> basis (batch, D), score, evidence, doubt, share of the starts that
   agree, inliers (batch, n).  0, or 1 without memory. */
int EXPORT(search)(int slots, const int *kinds, const int *dims, const double *const *views, const ptrdiff_t *strides,
                   const double *weights, const double *scales, const double *limits, const long long *seeds, ptrdiff_t batch,
                   ptrdiff_t n, int mode, int starts, int keep, int iterations, int minimal, const double *rules, double *basis,
                   double *score, double *found, unsigned char *doubt, double *agreeing, unsigned char *inliers) {
  Slot slot[MAX_SLOTS];
  Bundle b;
  int coordinates = describe(&b, slot, slots, kinds, dims, views, strides, n), all_packed = 0, moments_size = 1;
  for (int s = 0; s < slots; s++) { all_packed += b.sizes[s]; moments_size *= b.sizes[s]; }
  int D = b.D;
  size_t columns_size = (size_t)coordinates * b.padded, packed_room = (size_t)all_packed * b.padded;
  size_t room = (WIDE + 1) * (size_t)b.padded + LANES, few = b.sizes[0] * b.padded + 6 * b.padded + (size_t)(keep + 2) * (D + 1);
  size_t doubles = moments_size * LANES + 2 * columns_size + packed_room + room + few;
  lanes *memory = aligned_alloc(64, (sizeof(lanes) * ((size_t)D * D + 2 * D) + sizeof(double) * doubles + 127) / 64 * 64);
  int *index = malloc(sizeof(int) * D * D);
  if (!memory || !index) { free(memory); free(index); return 1; }
  b.G = memory; b.f = b.G + D * D; b.start = b.f + D;
  b.moments = (double *)(b.start + D);
  double *columns = b.moments + moments_size * LANES, *shifted = columns + columns_size, *packed = shifted + columns_size;
  b.weighted = packed + packed_room; b.room = b.weighted + b.sizes[0] * b.padded;
  b.square = b.room + room; b.rows = b.square + b.padded; b.omega = b.rows + b.padded;
  double *weight = b.omega + b.padded, *other = weight + b.padded, *tensors = other + 2 * b.padded;
  double *lost = tensors + (size_t)keep * D, *generic = lost + keep;
  b.index = index; b.rules = rules; b.lengths = other + b.padded;
  generic_directions(generic, 1, D);
  unpacking(slot, slots, D, index);
  int failed = 0;
  for (ptrdiff_t p = 0; p < batch && !failed; p++) {
    double limit = limits[p], *pack = packed, origin[MAX_SPACE] = {0};
    take(&b, p, weights, scales, columns, weight);
    for (int s = 0; s < slots; s++) {
      b.packed[s] = pack;
      for (ptrdiff_t start = 0; start < b.padded; start += CHUNK) {
        int width = b.padded - start < CHUNK ? (int)(b.padded - start) : CHUNK;
        pack_slot(slot + s, b.columns[s] + start, b.padded, width, 1, origin, NULL, pack + start, b.padded);
      }
      pack += b.sizes[s] * b.padded;
    }
    measure_lengths(&b);
    int have = 1, best = 0, open_, free_ = 0;
    if (mode == LEAST_MEDIAN) {
      score[p] = least_median(&b, starts, (5 * minimal + 1) / 2, seeds[p], iterations, moments_size, generic, tensors);
      failed = score[p] < 0;
      continue;
    }
    agreeing[p] = 0;
    if (mode == AS_GIVEN) memcpy(tensors, basis + p * D, sizeof(double) * D);
    else if (mode == FROM_ALL) first_of_all(&b, moments_size, generic, tensors);
    else if (mode == FROM_SUBSETS) {
      have = subsets(&b, starts, (5 * minimal + 1) / 2, seeds[p], moments_size, generic, tensors) ? starts : -1;
      free_ = (have + (int)rules[STARTS_PER_UNGUIDED] - 1) / (int)rules[STARTS_PER_UNGUIDED];
    } else have = sampled(&b, starts, minimal, keep, seeds[p], limit, generic, shifted, other, lost, tensors);
    if (have < 0) { failed = 1; break; }
    if (mode != AS_GIVEN) {
      int led = mode == FROM_SUBSETS ? have - free_ : 0;
      reweight(&b, tensors, have - led, limit, iterations, ANNEALED, moments_size);
      reweight(&b, tensors + (have - led) * D, led, limit, (int)rules[GUIDED_REWEIGHTINGS], GUIDED, moments_size);
      for (int i = 0; i < have; i++) {
        lost[i] = score_of(&b, tensors + i * D, b.columns, b.weights, limit, 0, 0);
        best = lost[i] < lost[best] ? i : best;
      }
      for (int i = 0; i < have; i++) agreeing[p] += lost[i] <= lost[best] * (1 + rules[SAME_SCORE]) + rules[SAME_SCORE];
      agreeing[p] = have >= rules[MIN_STARTS_TO_COMPARE] ? agreeing[p] / have : 0;
      memmove(tensors, tensors + best * D, sizeof(double) * D);
      reweight(&b, tensors, 1, limit, (int)rules[NUM_CONCENTRATIONS], WITHIN, moments_size);
    }
    distances(&b, tensors, b.columns, b.square, b.rows);
    score[p] = score_of(&b, tensors, b.columns, b.weights, limit, 0, 0);
    found[p] = evidence(&b, tensors, limit, minimal, shifted, other, &open_);
    doubt[p] = open_;
    memcpy(basis + p * D, tensors, sizeof(double) * D);
    for (ptrdiff_t k = 0; k < n; k++) inliers[p * n + k] = b.square[k] <= limit;
  }
  free(memory);
  free(index);
  return failed;
}
