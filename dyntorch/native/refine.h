/* Refinement: Levenberg-Marquardt on the motion of a fundamental matrix, a collineation or a homography tensor, one problem after
   the other; the mathematics is that of dyntorch/core/refine.py and numerics/least_squares.py. */

enum { FIRST_DAMPING, INCREASE, DECREASE, LEAST_DAMPING, STUCK_DAMPING, TOLERANCE, SHORT_STEP };  /* rules, see least_squares.py */

typedef struct { double theta[MAX_PARAMETERS], cost, gradient[MAX_PARAMETERS], matrix[MAX_PARAMETERS * MAX_PARAMETERS]; } Place;

typedef struct { lanes cost, gradient[MAX_ENTRIES], matrix[MAX_ENTRIES * (MAX_ENTRIES + 1) / 2]; } Sums;

/* One residual r with slopes (size) and weights, added to the sums. */
static inline void add_residual(Sums *sums, lanes weight, lanes r, const lanes *slope, int size) {
  int place = 0;
  sums->cost += weight * r * r;
  for (int i = 0; i < size; i++) {
    lanes part = weight * slope[i];
    sums->gradient[i] += part * r;
    for (int j = 0; j <= i; j++) sums->matrix[place++] += part * slope[j];
  }
}

/* Signed Sampson distances of a form of two or three points, and their derivatives by its entries. */
static inline __attribute__((always_inline)) void add_form(const Bundle *b, const double *f, Sums *sums, int count, int d0, int d1, int d2) {
  const int dims[3] = {d0, d1, d2}, last = count > 2 ? d2 + 1 : 1;
  for (ptrdiff_t k = 0; k < b->padded; k += LANES) {
    lanes slopes[3][MAX_SPACE + 1], entry[MAX_ENTRIES], u[3][MAX_SPACE + 1], total = all(SINGULAR_SLOPE);
    lanes value = form_of(f, b->columns, b->padded, k, count, d0 + 1, d1 + 1, last, slopes);
    for (int s = 0; s < count; s++) for (int c = 0; c < dims[s]; c++) total += b->scales[s] * b->scales[s] * slopes[s][c] * slopes[s][c];
    lanes length = all(1) / root(total), share = value / total;
    for (int s = 0; s < count; s++) {  /* slopes: from here on what the entries of a slot take from the residual */
      for (int c = 0; c <= dims[s]; c++) u[s][c] = c < dims[s] ? AT(b->columns[s] + c * b->padded, k) : all(1);
      for (int c = 0; c < dims[s]; c++) slopes[s][c] *= share * (b->scales[s] * b->scales[s]);
      slopes[s][dims[s]] = all(0);
    }
    for (int i = 0; i <= d0; i++) for (int j = 0; j <= d1; j++) {
      lanes product = u[0][i] * u[1][j], bent = u[0][i] * (u[1][j] - slopes[1][j]) - slopes[0][i] * u[1][j];
      if (count == 2) entry[i * (d1 + 1) + j] = bent * length;
      else for (int l = 0; l < last; l++) entry[(i * (d1 + 1) + j) * last + l] = (bent * u[2][l] - product * slopes[2][l]) * length;
    }
    add_residual(sums, AT(b->weights, k), value * length, entry, (d0 + 1) * (d1 + 1) * last);
  }
}

/* Whitened distances of points from where a collineation carries those of the other view, and their derivatives by its entries. */
static void add_transfer(const Bundle *b, const double *A, Sums *sums) {
  int slot = b->transfer, d = b->slots[slot].dim, size = (d + 1) * (d + 1);
  const double *point = b->columns[1 - slot];
  double own = b->scales[slot] * b->scales[slot], other = b->scales[1 - slot] * b->scales[1 - slot];
  for (ptrdiff_t k = 0; k < b->padded; k += LANES) {
    lanes y[4], p[4], place[3], J[3][3], L[3][3], inner[3][3], w[3], raw[3], most = all(0);
    for (int c = 0; c <= d; c++) p[c] = c < d ? AT(point + c * b->padded, k) : all(1);
    for (int i = 0; i <= d; i++) {
      y[i] = all(0);
      for (int c = 0; c <= d; c++) y[i] += A[i * (d + 1) + c] * p[c];
      most = larger(absolute(y[i]), most);
    }
    lanes floor_ = most * EPS, stand_in = where(floor_ > all(0), where(y[d] < all(0), -floor_, floor_), all(1));
    lanes by = all(1) / where(absolute(y[d]) > floor_, y[d], stand_in);
    for (int i = 0; i < d; i++) {
      place[i] = y[i] * by;
      for (int c = 0; c < d; c++) J[i][c] = (A[i * (d + 1) + c] - place[i] * A[d * (d + 1) + c]) * by;
    }
    for (int i = 0; i < d; i++) {  /* L holds reciprocals on its diagonal */
      for (int j = 0; j <= i; j++) {
        inner[i][j] = all(i == j ? own : 0);
        for (int c = 0; c < d; c++) inner[i][j] += other * J[i][c] * J[j][c];
        for (int l = 0; l < j; l++) inner[i][j] -= L[i][l] * L[j][l];
        L[i][j] = i == j ? all(1) / root(larger(inner[i][j], all(EPS * EPS))) : inner[i][j] * L[j][j];
      }
      raw[i] = place[i] - AT(b->columns[slot] + i * b->padded, k);
      for (int j = 0; j < i; j++) raw[i] -= L[i][j] * w[j];
      w[i] = raw[i] * L[i][i];
    }
    lanes slope[3][MAX_ENTRIES];
    for (int e = 0; e < size; e++) {  /* forward, entry by entry */
      int row = e / (d + 1), column = e % (d + 1);
      lanes away = row == d ? p[column] * by : all(0), dplace[3], dJ[3][3], dL[3][3];
      for (int i = 0; i < d; i++) {
        dplace[i] = (row == i ? p[column] * by : all(0)) - place[i] * away;
        for (int c = 0; c < d; c++) {
          lanes direct = all(row == i && column == c);
          if (row == d && column == c) direct -= place[i];
          dJ[i][c] = (direct - dplace[i] * A[d * (d + 1) + c]) * by - J[i][c] * away;
        }
      }
      for (int i = 0; i < d; i++) {
        for (int j = 0; j <= i; j++) {
          lanes change = all(0);
          for (int c = 0; c < d; c++) change += dJ[i][c] * J[j][c] + J[i][c] * dJ[j][c];
          change *= other;
          for (int l = 0; l < j; l++) change -= dL[i][l] * L[j][l] + L[i][l] * dL[j][l];
          dL[i][j] = i == j ? -.5 * change * L[i][i] * L[i][i] * L[i][i] : change * L[j][j] + inner[i][j] * dL[j][j];
        }
        lanes change = dplace[i];
        for (int j = 0; j < i; j++) change -= dL[i][j] * w[j] + L[i][j] * slope[j][e];
        slope[i][e] = change * L[i][i] + raw[i] * dL[i][i];
      }
    }
    for (int i = 0; i < d; i++) add_residual(sums, AT(b->weights, k), w[i], slope[i], size);
  }
}

/* Cost, gradient and Gauss-Newton matrix, parts of the motion at norm 1. */
static void evaluate(const Bundle *b, int constraint, Place *at) {
  Sums sums;
  int entries = b->D, count = parameters_of(constraint, b->D);
  double f[MAX_ENTRIES], slope[MAX_PARAMETERS][MAX_ENTRIES], gradient[MAX_ENTRIES], matrix[MAX_ENTRIES][MAX_ENTRIES];
  memset(&sums, 0, sizeof sums);
  compose(at->theta, constraint, entries, f, slope);
  if (constraint == RANK_TWO) add_form(b, f, &sums, 2, 2, 2, 0);
  else if (constraint == HOMOGRAPHIES) add_form(b, f, &sums, 3, 2, 2, 2);
  else add_transfer(b, f, &sums);
  at->cost = 0;
  for (int v = 0; v < LANES; v++) at->cost += sums.cost[v];
  if (!(at->cost <= 1e300)) at->cost = INFINITY;
  for (int i = 0, place = 0; i < entries; i++) {
    gradient[i] = 0;
    for (int v = 0; v < LANES; v++) gradient[i] += sums.gradient[i][v];
    for (int j = 0; j <= i; j++, place++) {
      double total = 0;
      for (int v = 0; v < LANES; v++) total += sums.matrix[place][v];
      matrix[i][j] = matrix[j][i] = total;
    }
  }
  if (constraint == NONSINGULAR) {
    for (int i = 0; i < count; i++) { at->gradient[i] = gradient[i]; memcpy(at->matrix + i * count, matrix[i], sizeof(double) * count); }
    return;
  }
  for (int p = 0; p < count; p++) {
    double bent[MAX_ENTRIES];
    at->gradient[p] = 0;
    for (int i = 0; i < entries; i++) {
      at->gradient[p] += slope[p][i] * gradient[i];
      bent[i] = 0;
      for (int j = 0; j < entries; j++) bent[i] += slope[p][j] * matrix[j][i];
    }
    for (int q = 0; q < count; q++) {
      at->matrix[p * count + q] = 0;
      for (int i = 0; i < entries; i++) at->matrix[p * count + q] += bent[i] * slope[q][i];
    }
  }
}

/* (H + damping diag H)^-1 g; whether it is a number. */
static int damped_step(const Place *at, int count, double damping, double *step) {
  double L[MAX_PARAMETERS][MAX_PARAMETERS], most = 0;
  for (int i = 0; i < count; i++) most = at->matrix[i * count + i] > most ? at->matrix[i * count + i] : most;
  int good = 1;
  for (int i = 0; i < count; i++) for (int j = 0; j <= i; j++) {
    double s = at->matrix[i * count + j];
    if (i == j) s += damping * (s + 1e-9 * most + 2.2250738585072014e-308);
    for (int k = 0; k < j; k++) s -= L[i][k] * L[j][k];
    if (i == j) { good &= s > 0; L[i][i] = sqrt(s); }
    else L[i][j] = s / L[j][j];
  }
  for (int i = 0; i < count; i++) {
    double s = at->gradient[i];
    for (int k = 0; k < i; k++) s -= L[i][k] * step[k];
    step[i] = s / L[i][i];
  }
  for (int i = count - 1; i >= 0; i--) {
    for (int k = i + 1; k < count; k++) step[i] -= L[k][i] * step[k];
    step[i] /= L[i][i];
  }
  for (int i = 0; i < count; i++) good &= isfinite(step[i]);
  return good;
}

/* Steps from one place until they no longer lower the cost; how many. */
static int descend(const Bundle *b, int constraint, int iterations, Place *at) {
  int count = parameters_of(constraint, b->D);
  double damping = b->rules[FIRST_DAMPING], least = b->rules[LEAST_DAMPING], step[MAX_PARAMETERS];
  evaluate(b, constraint, at);
  if (!isfinite(at->cost)) return 0;
  for (int taken = 1; taken <= iterations; taken++) {
    Place fresh;
    double length = 0;
    while (!damped_step(at, count, damping, step)) {  /* rounding of what the matches leave open: no less damping from here on */
      if (damping > b->rules[STUCK_DAMPING]) return taken;
      least = damping *= b->rules[INCREASE];
    }
    for (int i = 0; i < count; i++) { fresh.theta[i] = at->theta[i] - step[i]; length = fabs(step[i]) > length ? fabs(step[i]) : length; }
    evaluate(b, constraint, &fresh);
    double fall = at->cost - fresh.cost;
    int better = fall > 0, done = better ? fall <= b->rules[TOLERANCE] * at->cost : damping > b->rules[STUCK_DAMPING];
    if (better) *at = fresh;
    if (done || length < b->rules[SHORT_STEP]) return taken;
    damping = better ? damping * b->rules[DECREASE] : damping * b->rules[INCREASE];
    damping = damping > least ? damping : least;
  }
  return iterations;
}

/* Motions (batch, p), refined in place, of normalized matches (see search), weights (batch, n) of any size: cost (batch), gradient
   (batch, p), Gauss-Newton matrix (batch, p, p) and steps (batch).  0, or 1 without memory. */
int EXPORT(refine)(int slots, const int *kinds, const int *dims, const double *const *views, const ptrdiff_t *strides,
                   const double *weights, const double *scales, ptrdiff_t batch, ptrdiff_t n, int constraint, int iterations,
                   const double *rules, double *motion, double *cost, double *gradient, double *matrix, long long *steps) {
  Slot slot[MAX_SLOTS];
  Bundle b;
  int coordinates = describe(&b, slot, slots, kinds, dims, views, strides, n), count = parameters_of(constraint, b.D);
  double *memory = malloc(sizeof(double) * ((size_t)(coordinates + 1) * b.padded + 1));
  if (!memory) return 1;
  b.rules = rules;
  for (ptrdiff_t p = 0; p < batch; p++) {
    Place at;
    take(&b, p, weights, scales, memory, memory + (size_t)coordinates * b.padded);
    memcpy(at.theta, motion + p * count, sizeof(double) * count);
    steps[p] = descend(&b, constraint, iterations, &at);
    memcpy(motion + p * count, at.theta, sizeof(double) * count);
    memcpy(gradient + p * count, at.gradient, sizeof(double) * count);
    memcpy(matrix + p * count * count, at.matrix, sizeof(double) * count * count);
    cost[p] = at.cost;
  }
  free(memory);
  return 0;
}

/* What a robust search found, refined on its inliers, which are chosen again after each of so many rounds of so many steps: tensors
   (batch, D) and weights (batch, n) in, both replaced by those of the last round that lost less, limits of the squared distance
   (batch) -> motion, cost, gradient, matrix as refine, and distances (batch, n).  0, or 1 without memory. */
int EXPORT(polish)(int slots, const int *kinds, const int *dims, const double *const *views, const ptrdiff_t *strides,
                   const double *scales, const double *limits, ptrdiff_t batch, ptrdiff_t n, int constraint, int rounds,
                   const int *iterations, const double *rules, double *tensors, double *weights, double *motion, double *cost,
                   double *gradient, double *matrix, double *distance) {
  Slot slot[MAX_SLOTS];
  Bundle b;
  int coordinates = describe(&b, slot, slots, kinds, dims, views, strides, n), D = b.D, count = parameters_of(constraint, D);
  double *memory = malloc(sizeof(double) * ((size_t)(coordinates + 4) * b.padded + 1));
  if (!memory) return 1;
  double *weight = memory + (size_t)coordinates * b.padded, *inlying = weight + b.padded, *rows = inlying + b.padded, *square = rows + b.padded;
  b.rules = rules;
  for (ptrdiff_t p = 0; p < batch; p++) {
    double *tensor = tensors + p * D, limit = limits[p], found[MAX_ENTRIES], slope[MAX_PARAMETERS][MAX_ENTRIES], score;
    Place at = {.cost = INFINITY}, kept = {.cost = INFINITY};
    take(&b, p, weights, scales, memory, weight);
    memcpy(found, tensor, sizeof(double) * D);
    constrain(found, constraint, dims[0] + 1);
    if (largest(found, D) > 0) memcpy(tensor, found, sizeof(double) * D);
    distances(&b, tensor, b.columns, square, rows);
    score = score_of(&b, tensor, b.columns, weight, limit, 0, 0);
    decompose(tensor, constraint, D, kept.theta);
    for (int round = 0; round < rounds; round++) {
      for (ptrdiff_t k = 0; k < b.padded; k++) inlying[k] = square[k] <= limit ? weight[k] : 0;
      at = kept;
      b.weights = inlying;
      descend(&b, constraint, iterations[round], &at);
      b.weights = weight;
      if (!isfinite(at.cost)) memcpy(at.theta, kept.theta, sizeof at.theta);
      compose(at.theta, constraint, D, found, slope);
      double fresh = score_of(&b, found, b.columns, weight, limit, 0, 0);
      if (round && !(fresh < score)) continue;
      score = fresh;
      kept = at;
      memcpy(tensor, found, sizeof(double) * D);
      memcpy(weights + p * n, inlying, sizeof(double) * n);
      distances(&b, tensor, b.columns, square, rows);
    }
    memcpy(motion + p * count, kept.theta, sizeof(double) * count);
    memcpy(gradient + p * count, kept.gradient, sizeof(double) * count);
    memcpy(matrix + p * count * count, kept.matrix, sizeof(double) * count * count);
    cost[p] = kept.cost;
    for (ptrdiff_t k = 0; k < n; k++) distance[p * n + k] = sqrt(square[k]);
  }
  free(memory);
  return 0;
}
