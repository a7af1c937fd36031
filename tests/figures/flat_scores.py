"""Cases of a comparison whose scores are the same in all bands."""

from __future__ import annotations

import numpy as np

from calstudy.power.score import BANDS, Score
from calstudy.products.comparison import Case

N_BANDS = len(BANDS) - 1


def case(bias=1.0, bias_error=0.1, transfer=0.9, transfer_error=0.01, **solves):
    """A case with the same scores in all bands of k; `solves` are their numbers by status."""
    edges = np.array(BANDS)
    given = {"bias": bias, "bias_error": bias_error, "transfer": transfer, "transfer_error": transfer_error}
    columns = {name: np.full(N_BANDS, value) for name, value in given.items()}
    unused = dict.fromkeys(("cross_transfer", "recovered", "recovered_error"), np.full(N_BANDS, np.nan))
    score = Score(k=edges[1:], bin_edges=edges, flux_scale=1.0, **unused, **columns)
    return Case(score, score, {"by_status": solves or {"converged": 4}})
