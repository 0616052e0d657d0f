/* Motions and the tensors that are composed of them: fundamental matrices, collineations and homography tensors; the mathematics is
   that of the files of dyntorch/invariants. */

enum { MAX_PARAMETERS = 18, MAX_ENTRIES = 27 };
enum { FIRST_ITERATIONS_OF_MOTION = 12, NEXT_ITERATIONS_OF_MOTION = 3, BALANCING_ITERATIONS = 2 };

/* Entries of the motion of a tensor of so many. */
static int parameters_of(int constraint, int entries) { return constraint == RANK_TWO ? 12 : constraint == HOMOGRAPHIES ? 18 : entries; }

/* A tensor (entries) of squared length at norm 1, and its derivative (count, entries) with it. */
static void project(double *f, double length, double slope[][MAX_ENTRIES], int count, int entries) {
  length = length > 0 ? sqrt(length) : 1;
  for (int i = 0; i < entries; i++) f[i] /= length;
  for (int p = 0; p < count; p++) {
    double along = 0;
    for (int i = 0; i < entries; i++) along += slope[p][i] * f[i];
    for (int i = 0; i < entries; i++) slope[p][i] = (slope[p][i] - along * f[i]) / length;
  }
}

/* The form [e]_x A at norm 1, entries in the order of the views, and its derivative (12, 9) by A and e. */
static void compose_fundamental(const double *theta, double *f, double slope[][MAX_ENTRIES]) {
  const double *A = theta, *e = theta + 9, S[3][3] = {{0, -e[2], e[1]}, {e[2], 0, -e[0]}, {-e[1], e[0], 0}};
  double length = 0;
  memset(slope, 0, sizeof(double) * 12 * MAX_ENTRIES);
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    f[3 * j + i] = S[i][0] * A[j] + S[i][1] * A[3 + j] + S[i][2] * A[6 + j];
    length += f[3 * j + i] * f[3 * j + i];
    for (int k = 0; k < 3; k++) {
      slope[3 * k + j][3 * j + i] = S[i][k];
      if (i != k) slope[9 + 3 - i - k][3 * j + i] = ((k - i + 3) % 3 == 1 ? -1 : 1) * A[3 * k + j];
    }
  }
  project(f, length, slope, 12, 9);
}

/* The homography tensor of A and B, columns a_j x b_k, at norm 1, and its derivative (18, 27) by both. */
static void compose_homographies(const double *theta, double *f, double slope[][MAX_ENTRIES]) {
  const double *A = theta, *B = theta + 9;
  double length = 0;
  memset(slope, 0, sizeof(double) * 18 * MAX_ENTRIES);
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) for (int k = 0; k < 3; k++) {
    int u = (i + 1) % 3, v = (i + 2) % 3, e = 9 * i + 3 * j + k;
    f[e] = A[3 * u + j] * B[3 * v + k] - A[3 * v + j] * B[3 * u + k];
    length += f[e] * f[e];
    slope[3 * u + j][e] = B[3 * v + k];
    slope[3 * v + j][e] = -B[3 * u + k];
    slope[9 + 3 * v + k][e] = A[3 * u + j];
    slope[9 + 3 * u + k][e] = -A[3 * v + j];
  }
  project(f, length, slope, 18, 27);
}

/* Homogeneous coordinates of each view scaled so that all slices of homography tensors T (27) are of similar size; by how much. */
static void balance_slices(lanes *T, lanes scales[3][3]) {
  const int steps[3] = {9, 3, 1};
  for (int s = 0; s < 3; s++) for (int c = 0; c < 3; c++) scales[s][c] = all(1);
  for (int pass = 0; pass < BALANCING_ITERATIONS; pass++) for (int s = 0; s < 3; s++) {
    int own = steps[s], first = steps[(s + 1) % 3], second = steps[(s + 2) % 3];
    lanes size[3], most = all(0);
    for (int c = 0; c < 3; c++) {
      size[c] = all(0);
      for (int e = 0; e < 9; e++) { lanes x = T[c * own + e / 3 * first + e % 3 * second]; size[c] += x * x; }
      size[c] = root(size[c]);
      most = larger(most, size[c]);
    }
    for (int c = 0; c < 3; c++) {  /* a slice of rounding errors is not blown up */
      size[c] = where(most > all(0), larger(size[c], most * 1e-8), all(1));
      lanes by = all(1) / size[c];
      scales[s][c] *= size[c];
      for (int e = 0; e < 9; e++) T[c * own + e / 3 * first + e % 3 * second] *= by;
    }
  }
}

/* The X (9) for which X^T S is skew for the slices S of T, whose rows are entries `row` apart, columns and slices alike, by inverse
   iteration from what X is. */
static void skew_partner(const lanes *T, int row, int column, int slice, int iterations, lanes *X) {
  lanes G[81], trace = all(0);
  for (int i = 0; i < 81; i++) G[i] = all(0);
  for (int k = 0; k < 3; k++) for (int m = 0; m < 3; m++) for (int n = m; n < 3; n++) {
    const lanes *S = T + k * slice;
    double weight = m == n ? 2 : 1.4142135623730951;
    int places[6], size = m == n ? 3 : 6;
    lanes entry[6];
    for (int l = 0; l < 3; l++) {
      places[2 * l * size / 6] = 3 * l + m;
      entry[2 * l * size / 6] = weight * S[l * row + n * column];
      if (m < n) { places[2 * l + 1] = 3 * l + n; entry[2 * l + 1] = weight * S[l * row + m * column]; }
    }
    for (int i = 0; i < size; i++) for (int j = 0; j <= i; j++) G[9 * places[i] + places[j]] += entry[i] * entry[j];
  }
  for (int i = 0; i < 9; i++) trace += G[10 * i];
  for (int i = 0; i < 9; i++) G[10 * i] += trace * 1e-15 + TINY;
  cholesky(G, 9);
  for (int k = 0; k < iterations; k++) { solve(G, 9, X); normalize(X, 9); }
}

/* The A and B (18) of homography tensors (27), LANES of them, each up to its scale: as decompose of the invariant has them.  X (18),
   the partners of the slices, is where the search for them starts and ends. */
static void motions_of(const lanes *f, int iterations, lanes *X, lanes *motion) {
  lanes T[27], scales[3][3];
  memcpy(T, f, sizeof T);
  balance_slices(T, scales);
  skew_partner(T, 9, 3, 1, iterations, X);
  skew_partner(T, 9, 1, 3, iterations, X + 9);
  for (int part = 0; part < 2; part++) {
    for (int l = 0; l < 3; l++) for (int x = 0; x < 3; x++) motion[9 * part + 3 * l + x] = X[9 * part + 3 * l + x] * scales[1 + part][x] / scales[0][l];
    normalize(motion + 9 * part, 9);
  }
}
static void generic_partners(lanes *X) {
  double generic[9];
  generic_directions(generic, 1, 9);
  for (int i = 0; i < 18; i++) X[i] = all(generic[i % 9]);
}

/* The tensors of the motions of tensors f (27), where they have one, else f: what guides a search. */
static void nearest_of_motions(const lanes *f, int iterations, lanes *X, lanes *nearest) {
  lanes motion[18];
  const lanes *A = motion, *B = motion + 9;
  motions_of(f, iterations, X, motion);
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) for (int k = 0; k < 3; k++) {
    int u = (i + 1) % 3, v = (i + 2) % 3;
    nearest[9 * i + 3 * j + k] = A[3 * u + j] * B[3 * v + k] - A[3 * v + j] * B[3 * u + k];
  }
  lanes length = root(dot(nearest, nearest, 27));
  mask sound = (length > all(TINY)) & (length < all(1 / TINY));
  for (int i = 0; i < 27; i++) nearest[i] = where(sound, nearest[i] / where(sound, length, all(1)), f[i]);
  if (any(~sound)) generic_partners(X);
}

/* The same of one tensor, of norm 1 and determinants not negative. */
static void decompose_homographies(const double *f, double *theta) {
  lanes T[27], X[18], motion[18];
  for (int i = 0; i < 27; i++) T[i] = all(f[i]);
  generic_partners(X);
  motions_of(T, FIRST_ITERATIONS_OF_MOTION, X, motion);
  for (int part = 0; part < 2; part++) {
    double *M = theta + 9 * part;
    for (int i = 0; i < 9; i++) M[i] = motion[9 * part + i][0];
    double det = M[0] * (M[4] * M[8] - M[5] * M[7]) - M[1] * (M[3] * M[8] - M[5] * M[6]) + M[2] * (M[3] * M[7] - M[4] * M[6]);
    if (det < 0) for (int i = 0; i < 9; i++) M[i] = -M[i];
  }
}

/* Norm 1, the largest entry positive. */
static void canonical(double *x, int size) {
  int most = 0;
  for (int i = 1; i < size; i++) if (fabs(x[i]) > fabs(x[most])) most = i;
  double sign = x[most] < 0 ? -1 : 1;
  unit_length(x, size);
  for (int i = 0; i < size; i++) x[i] *= sign;
}

/* The motion of a tensor, entries in the order of the views: as decompose of the invariants has it. */
static void decompose(const double *f, int constraint, int size, double *theta) {
  if (constraint == HOMOGRAPHIES) { decompose_homographies(f, theta); return; }
  if (constraint != RANK_TWO) { memcpy(theta, f, sizeof(double) * size); unit_length(theta, size); return; }
  double e1[3], *e2 = theta + 9, F[9];
  null_vectors(f, e1, e2);
  canonical(e1, 3);
  canonical(e2, 3);
  memcpy(F, f, sizeof F);
  canonical(F, 9);
  const double S[3][3] = {{0, -e2[2], e2[1]}, {e2[2], 0, -e2[0]}, {-e2[1], e2[0], 0}};
  for (int i = 0; i < 3; i++) for (int j = 0; j < 3; j++) {
    theta[3 * i + j] = 0.70710678118654752 * e2[i] * e1[j];
    for (int k = 0; k < 3; k++) theta[3 * i + j] -= S[i][k] * F[3 * j + k];
  }
  unit_length(theta, 9);
}

/* The tensor of a motion, parts at norm 1, and its derivative (parameters, D). */
static void compose(double *theta, int constraint, int size, double *f, double slope[][MAX_ENTRIES]) {
  unit_length(theta, constraint == RANK_TWO || constraint == HOMOGRAPHIES ? 9 : size);
  if (constraint == RANK_TWO) { unit_length(theta + 9, 3); compose_fundamental(theta, f, slope); }
  else if (constraint == HOMOGRAPHIES) { unit_length(theta + 9, 9); compose_homographies(theta, f, slope); }
  else memcpy(f, theta, sizeof(double) * size);
}
