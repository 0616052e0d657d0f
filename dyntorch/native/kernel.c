/* The kernel: many small problems, LANES side by side in vector registers ("batch last"), float64.

   Compiled once per instruction set: -DLANES=8 (AVX-512), 4 (AVX2), 2 (SSE2, NEON), -DSUFFIX=... names the functions.  Plain C
   interface, no state, no other library.  What cannot be certified is reported as such and left to the caller; a problem that is
   not finite spoils none of its neighbours. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#define JOIN_(name, suffix) name##_##suffix
#define JOIN(name, suffix) JOIN_(name, suffix)
#define EXPORT(name) __attribute__((visibility("default"))) JOIN(name, SUFFIX)

#include "lanes.h"
#include "null_space.h"
#include "fit.h"
#include "motion.h"
#include "search.h"
#include "refine.h"

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
