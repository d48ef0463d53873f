"""Weights of multiple importance sampling."""

import warp as wp


@wp.func
def power_heuristic(pdf: float, other_pdf: float) -> float:
    """Weight of a sample of density `pdf` against one other technique (Veach 1997, section 9.2.2, beta = 2).

    Written with the ratio of the densities, so that their squares cannot overflow. Zero if `pdf` is zero.
    """
    if pdf <= 0.0:
        return 0.0
    ratio = other_pdf / pdf
    return 1.0 / (1.0 + ratio * ratio)
