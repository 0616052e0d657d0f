r"""Counting: how many matches a multilinear constraint takes, and how many tensors satisfy them all.  Exact, without torch.

:func:`dim_v` is the dimension of :math:`V(n,m,k)`, the constraints of points that move within extensors of step k, by
hook lengths.  :func:`count` gives the exact rank of the estimation matrix of any configuration of matches over a prime field:
of the invariants, of the motion models of :func:`dyntorch.reconstruct` by name, and of any Grassmann tensor by its profile.

Both reproduce the numbers of the thesis, except where it is wrong:

- Section 1.3: the tensor of six views of points on trajectory lines has 729 entries ("36"); its 728 matches are right.
- Section 8.1, 9.3: at most 8 points of a trajectory line help, but four lines with 8 + 8 + 8 + 2 of 26 points reach rank 23 only;
  8 + 7 + 6 + 5 reach 26.
- Section 8.2: one minimal join tensor does not determine A.  The equations of its slices have rank 11 of 16; with a second camera
  they have 15.
- Section 8.3: the constant velocity tensor belongs to projections from P^6 ("P^7") to P^3 ("P^2"); from P^7 there is no constraint.
  The velocities must span space: velocities in a plane reach rank 58 of 63, along a line 49, equal ones no more than static
  points, 36.  The 3x4x4 variant is smaller but takes more matches, 24 instead of 21.
- Section 8.4: lines of two rigid translating objects reach rank 28, not the 31 of pure translations, which take three objects;
  with two static points they reach 35.
- Sections 9.3, 9.4: V(n,m,k) needs no n >= m, which the thesis's own V(2,3,2) and V(3,4,2) violate; its first definition
  lacks the span, and "s_lambda" in claim 1 must be d_lambda(n).
- Section 9.4: partitions of m longer than k correspond to all partitions of all numbers up to m - k - 1 only where
  m <= 2k + 2.  Its closed forms are right: they use m - k <= 3, with the (2, 2, 1...) term absent at m = 3.
"""

from dyntorch.counting.configurations import CONFIGURATIONS
from dyntorch.counting.dimension import dim_v, dim_v_closed_form, partitions, semistandard_tableaux, standard_tableaux
from dyntorch.counting.exact import Field, Kind
from dyntorch.counting.ranks import Capacity, Count, capacities, count, options_of

__all__ = [
    "CONFIGURATIONS", "Capacity", "Count", "Field", "Kind", "capacities", "count", "dim_v", "dim_v_closed_form", "options_of",
    "partitions", "semistandard_tableaux", "standard_tableaux",
]  # fmt: skip
