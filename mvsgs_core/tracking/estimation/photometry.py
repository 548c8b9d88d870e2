"""Photometric calibration of a graph of images from the gray levels of their matches (Bergmann et al. 2018, DSO 2017).

Of an edge from image a to b, the log ratio of a point's gray levels is, with t(I) = m / I - 1 (response.py),
    log I_b - log I_a = (g_b - g_a) + (h_b - h_a) t(I) + (1 + k t(I)) (v(r_b) - v(r_a)) + u + w t(I) + noise
with gain g and lift h of an image, v(r) the log gain of mid gray by the vignetting (three parameters), and k that of
the response: vignetting, too, is of the light. What a whole edge is off together (light
that surfaces send elsewhere, glare, wrong matches) are random effects u and w of its own, whose sizes the edges'
disagreement over the graph tells: so that the uncertainties are those of edges and not of pixels. All is linear, and an
edge takes part by its moments (gray_levels.py): a solution is as cheap as a pose graph's.

What is free is asked of the data, by the Bayesian information criterion on that solution: nothing (a steady camera:
zero, exactly), gains, gains and a response (h = k g), or gain and lift of each image; and white balance and vignetting.
The gauge: the mean over the images is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mvsgs_core.tracking.estimation.gray_levels import of_response
from mvsgs_core.tracking.estimation.response import affine, change, vignetting_change

EDGE_SIGMA = 0.005  # what an edge is off, as a log ratio, before the edges tell it; it counts as ...
_PRIOR_EDGES = 10  # ... so many of them
STEP = 2.0 / 255.0  # gray levels, root mean square: less is no change, texture that is resampled differs by as much
KNOWN_SIGMA = 0.02  # of a known exposure's logarithm: shutters and apertures are rounded; the images may tell more
CONTRADICTED = 0.06  # root mean square of what gains are off from known exposures: more is no rounding
_EXPONENT, _EXPONENT_SIGMA = 0.5, 0.25  # of gray levels over exposure: gamma-coded images have about 1 / 2.2
WHITE_SIGMA = 0.1  # by which channels may differ between two images, log ratio: taken out of what they say together
_CONTRASTS = np.array([[1.0, 1.0], [0.0, -2.0], [-1.0, 1.0]]) / np.sqrt([2.0, 6.0])  # of the channels, (3, 2)
_STEPS = 8
_GLOBAL = 3  # parameters of the vignetting


@dataclass(frozen=True)
class PhotometricEdges:
    """E pairs of images, by number, with what their matched gray levels say."""

    source: np.ndarray  # (E,) int
    to: np.ndarray  # (E,) int
    moments: np.ndarray  # (E, 3, 9, 9) float64, see `gray_levels.log_ratio_moments`


@dataclass(frozen=True)
class PhotometricCalibration:
    """Of K images. Zeros: a steady camera's, exactly."""

    gains: np.ndarray  # (K,) log gain, mean zero
    lifts: np.ndarray  # (K,) what dark levels gain over it, see response.py
    white: np.ndarray  # (K, 3) log gain of the channels over the gain
    sigma: np.ndarray  # (K,) standard deviation of the gains
    vignetting: np.ndarray  # (3,) of the log gain of mid gray l1 r² + l2 r⁴ + l3 r⁶
    vignetting_response: float  # lift over gain of the vignetting
    response: float  # of the exposures: the sensor's
    own_lifts: bool  # lifts are the images' own: more than the response says
    edge_sigma: tuple[float, float]  # of u and w, log ratios
    known_off: float = 0.0  # root mean square of what gains are off from known exposures; 0: none is known

    @staticmethod
    def steady(count: int) -> PhotometricCalibration:
        """Of `count` images of which nothing is known to change."""
        zero = np.zeros(count)
        edge = (EDGE_SIGMA, EDGE_SIGMA)
        return PhotometricCalibration(zero, zero, np.zeros((count, 3)), zero, np.zeros(_GLOBAL), 0.0, 0.0, False, edge)

    @cached_property
    def varies(self) -> bool:
        return bool(np.any(self.gains) or np.any(self.white))

    @property
    def warning(self) -> str:
        """What a user should know of the known exposures; empty: nothing."""
        if self.known_off <= CONTRADICTED:
            return ""
        return (
            "the exposures that came with the images (EXIF, or the stream's) do not fit what the images show, so that "
            "they count less: the light changed, or they are wrong"
        )

    @property
    def lights(self) -> np.ndarray:
        """(K, 5) log gain, lift and white balance: what adds up along edges."""
        return np.column_stack([self.gains, self.lifts, self.white])

    def step(self, moments: np.ndarray) -> np.ndarray:
        """Light (5,) of an edge's end less that of its start, from its moments (3, 9, 9), or their first two rows."""
        moments = of_response(moments[:, :2], self.vignetting_response)
        pooled = _pooled(moments)
        ratio = pooled[:, 5] - pooled[:, 2:5] @ self.vignetting
        if self.own_lifts:
            gain, lift = np.linalg.solve(pooled[:, :2] + 1e-9 * np.eye(2), ratio)
        else:
            along = np.array([1.0, self.response])
            gain = along @ ratio / (along @ pooled[:, :2] @ along)
            lift = self.response * gain
        result = np.array([gain, lift, 0.0, 0.0, 0.0])
        if np.any(self.white):
            first = moments[:, 0]
            left = first[:, 5] - first[:, 2:5] @ self.vignetting - gain * first[:, 0] - lift * first[:, 1]
            left = left / (first[:, 0] + self.response * first[:, 1])
            result[2:] = left - left.mean()
        return result

    def affine(self, light: np.ndarray) -> np.ndarray:
        """(3, 4) float32 color affine [A | b] of a light (5,)."""
        gain, lift, white = light[0], light[1], light[2:]
        slope, offset = affine(gain + white, lift + self.response * white)
        return np.concatenate([np.diag(slope), offset[:, None]], axis=1).astype(np.float32)


class _Solver:
    """Least squares on gains and lifts (2 K), the vignetting (3), and the exponent and unit of known exposures."""

    def __init__(self, edges: PhotometricEdges, count: int, known: np.ndarray) -> None:
        """known (K,): log exposures, NaN where they are not known."""
        self.edges, self.count = edges, count
        self.moments = _pooled(_square(edges.moments, 0.0))
        self.known = np.flatnonzero(np.isfinite(known))
        self.logs = known[self.known] - known[self.known].mean() if len(self.known) else known[:0]
        # Edges speak first: known exposures that they contradict would make them all look wrong.
        self.known_weights = np.ones(len(self.known))
        self.trust = np.ones(len(self.moments))
        self.effects = np.array([EDGE_SIGMA**2, EDGE_SIGMA**2])  # variances of u and w
        self.solution = np.zeros(0)
        self.information = np.zeros((0, 0))
        self.scores = np.zeros((0, 5))

    def solve(self, vignetted: bool) -> None:
        """Raises numpy.linalg.LinAlgError where the equations have no solution."""
        for _ in range(_STEPS):
            information, right = self._equations(vignetted)
            before, self.solution = self.solution, np.linalg.solve(information, right)
            self.information = information
            self._weigh()
            if before.shape == self.solution.shape and np.abs(before - self.solution).max() < 1e-5:
                break

    def follow(self, response: float) -> bool:
        """Has the vignetting follow a response where that explains the edges better; their weights stay."""
        before, moments = self.explained(), self.moments
        self.moments = _pooled(_square(self.edges.moments, response))
        if self.explained() > before:
            return True
        self.moments = moments
        return False

    def explained(self) -> float:
        """What the best solution, with the vignetting, takes off the edges' weighted squares."""
        information, right = self._equations(True)
        return float(right @ np.linalg.solve(information, right))

    @property
    def nodes(self) -> np.ndarray:
        """(2 K,) gains, then lifts, means zero."""
        halves = self.solution[: 2 * self.count].reshape(2, -1)
        return np.asarray((halves - halves.mean(axis=1, keepdims=True)).ravel())

    @property
    def vignetting(self) -> np.ndarray:
        return self.solution[2 * self.count : 2 * self.count + _GLOBAL]

    def of_nodes(self) -> np.ndarray:
        """(2 K, 2 K) information of gains and lifts, all else unknown."""
        n = 2 * self.count
        inner, outer = self.information[:n, :n], self.information[:n, n:]
        return np.asarray(inner - outer @ np.linalg.solve(self.information[n:, n:], outer.T))

    def vignetting_shows(self) -> bool:
        """Whether it is known against zero, by the scatter of the edges of each image too, and changes gray levels."""
        if vignetting_change(self.vignetting) < STEP:
            return False
        n, chosen = self.count, slice(2 * self.count, 2 * self.count + _GLOBAL)
        unit = np.zeros((len(self.information), _GLOBAL))
        unit[chosen] = np.eye(_GLOBAL)
        reach = np.linalg.solve(self.information, unit)
        by_edge = self.scores[:, 2:] @ reach[chosen]
        for k in (0, 1):
            by_edge += self.scores[:, k, None] * (reach[self.edges.to + k * n] - reach[self.edges.source + k * n])
        by_image = np.zeros((n, _GLOBAL))
        np.add.at(by_image, self.edges.source, by_edge)
        covariance = reach[chosen] + by_image.T @ by_image
        value = self.vignetting @ np.linalg.solve(covariance, self.vignetting)
        return bool(value > _GLOBAL * np.log(max(len(self.scores), 3)))

    def _equations(self, vignetted: bool) -> tuple[np.ndarray, np.ndarray]:
        a, b, n = self.edges.source, self.edges.to, self.count
        inner, right_of = self._marginal()
        end = 2 * n + _GLOBAL
        size = end + (2 if len(self.known) else 0)
        information, right = np.zeros((size, size)), np.zeros(size)
        for i in (0, 1):
            for k in (0, 1):
                for row, column, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
                    np.add.at(information, (row + i * n, column + k * n), sign * inner[:, i, k])
            np.add.at(right, b + i * n, right_of[:, i])
            np.add.at(right, a + i * n, -right_of[:, i])
            if vignetted:
                np.add.at(information[:, 2 * n : end], b + i * n, inner[:, i, 2:])
                np.add.at(information[:, 2 * n : end], a + i * n, -inner[:, i, 2:])
        information[2 * n : end, : 2 * n] = information[: 2 * n, 2 * n : end].T
        if vignetted:
            information[2 * n : end, 2 * n : end] = inner[:, 2:, 2:].sum(axis=0)
            right[2 * n : end] = right_of[:, 2:].sum(axis=0)
        weak = 1e-6 * inner[:, [0, 1], [0, 1]].mean(axis=0)  # parts without edges between them: mean zero each
        information[range(2 * n), range(2 * n)] += np.repeat(weak, n)
        information[range(2 * n, end), range(2 * n, end)] += 1.0  # of no weight, but where nothing says anything
        if len(self.known):
            self._add_known(information, right)
        return information, right

    def _marginal(self) -> tuple[np.ndarray, np.ndarray]:
        """Information (E, 5, 5) and right side (E, 5) of the edges, their random effects marginalized."""
        effect = self.moments[:, :, :2]  # with u and w
        share = np.linalg.inv(effect[:, :2] + np.diag(1.0 / self.effects))
        left = self.moments - effect @ share @ effect.transpose(0, 2, 1)
        left *= self.trust[:, None, None]
        return left[:, :5, :5], left[:, :5, 5]

    def _weigh(self) -> None:
        """What edges are off, from their disagreement, and the trust in each (Cauchy): a wrong match is one edge."""
        n, a, b = self.count, self.edges.source, self.edges.to
        rest = np.zeros((len(self.moments), 6))
        for k in (0, 1):
            rest[:, k] = self.solution[a + k * n] - self.solution[b + k * n]
        rest[:, 2:5], rest[:, 5] = -self.vignetting, 1.0
        own = np.linalg.inv(self.moments[:, :2, :2] + 1e-9 * np.eye(2))
        off = (own @ (self.moments[:, :2] @ rest[:, :, None]))[:, :, 0]
        for k in (0, 1):
            self.effects[k] = _edge_variance(off[:, k], own[:, k, k], n)
        scatter = own + np.diag(self.effects)
        distance = (off * np.linalg.solve(scatter, off[:, :, None])[:, :, 0]).sum(axis=1)
        inner, right_of = self._marginal()
        self.scores = right_of + (inner @ rest[:, :5, None])[:, :, 0]
        self.trust = 1.0 / (1.0 + distance / 8.0)
        if len(self.known):
            square = self.known_off**2
            variance = max(KNOWN_SIGMA**2, float(np.median(square)) / 0.4549)
            self.known_weights = 1.0 / (variance + square / 4.0)

    @property
    def known_off(self) -> np.ndarray:
        """What the gains are off from those that the known exposures give."""
        exponent, unit = self.solution[-2:]
        return np.asarray(self.solution[self.known] - exponent * self.logs - unit)

    def _add_known(self, information: np.ndarray, right: np.ndarray) -> None:
        """gain = exponent * log exposure + unit, each as far as the edges bear it out (Cauchy)."""
        rows = np.zeros((len(self.known), len(right)))
        rows[range(len(rows)), self.known], rows[:, -2], rows[:, -1] = 1.0, -self.logs, -1.0
        information += rows.T @ (self.known_weights[:, None] * rows)
        information[-2, -2] += _EXPONENT_SIGMA**-2
        right[-2] += _EXPONENT / _EXPONENT_SIGMA**2


def solve_photometry(edges: PhotometricEdges, count: int, known: np.ndarray | None = None) -> PhotometricCalibration:
    """That of `count` images from their edges.

    known (K,): log exposures of the images, NaN where they are not known.
    Raises numpy.linalg.LinAlgError where there is no solution, ValueError where it is not finite.
    """
    if count < 2 or len(edges.source) == 0:
        return PhotometricCalibration.steady(count)
    solver = _Solver(edges, count, np.full(count, np.nan) if known is None else known)
    solver.solve(True)
    vignetting, follows = np.zeros(_GLOBAL), 0.0
    if solver.vignetting_shows():
        _, response, _ = _chosen(solver.nodes, solver.of_nodes(), count, len(edges.source))
        if solver.follow(response):
            follows = response
            solver.solve(True)
        vignetting = solver.vignetting
    else:
        solver.solve(False)
    information = solver.of_nodes()
    nodes, response, own_lifts = _chosen(solver.nodes, information, count, len(edges.source))
    gains, lifts = nodes[:count], nodes[count:]
    first = of_response(edges.moments[:, :, 0], follows)
    white = _white_balance(edges, first, (gains, lifts), vignetting, response)
    u, w = np.sqrt(solver.effects)
    sigma = np.sqrt(np.diag(np.linalg.inv(_centered(information[:count, :count]))))
    known_off = float(np.sqrt(np.mean(solver.known_off**2))) if len(solver.known) else 0.0
    found = PhotometricCalibration(
        gains, lifts, white, sigma, vignetting, follows, response, own_lifts, (float(u), float(w)), known_off
    )
    if not all(np.isfinite(v).all() for v in (gains, lifts, white, sigma, vignetting)):
        raise ValueError("the photometric solution is not finite")
    return found


def _chosen(nodes: np.ndarray, information: np.ndarray, count: int, edges: int) -> tuple[np.ndarray, float, bool]:
    """Gains and lifts (2 K,) of the model that the data ask for (the least information criterion), the response that
    is nearest to them, and whether lifts are the images' own."""
    n, price = count, float(np.log(max(edges, 3)))

    def criterion(model: np.ndarray, parameters: int) -> float:
        off = nodes - model
        return float(off @ information @ off) + price * parameters

    response = 0.0
    gains = _gains_along(nodes, information, response)
    models = [(criterion(np.zeros(2 * n), 0), np.zeros(2 * n), False)]
    models.append((criterion(np.concatenate([gains, 0.0 * gains]), n - 1), np.concatenate([gains, 0.0 * gains]), False))
    for _ in range(6):
        toward = information @ np.concatenate([np.zeros(n), gains])
        spread = float(toward[n:] @ gains)
        if spread <= 0.0:
            break
        response = float(toward @ (nodes - np.concatenate([gains, np.zeros(n)]))) / spread
        response = min(max(response, -0.5), 0.9)  # beyond, gray levels would not grow with the light
        gains = _gains_along(nodes, information, response)
    along = np.concatenate([gains, response * gains])
    models.append((criterion(along, n), along, False))
    models.append((criterion(nodes, 2 * (n - 1)), nodes, True))
    which = min(range(len(models)), key=lambda m: models[m][0])
    _, best, own_lifts = models[which]
    halves = best.reshape(2, n) - best.reshape(2, n).mean(axis=1, keepdims=True)
    if change(halves[0], halves[1]) < STEP:
        return np.zeros(2 * n), 0.0, False
    return np.asarray(halves.ravel()), response if which >= 2 else 0.0, own_lifts


def _gains_along(nodes: np.ndarray, information: np.ndarray, response: float) -> np.ndarray:
    """(K,) gains that are nearest to the solution where lifts are `response` times them."""
    n = len(nodes) // 2
    both = information[:n] + response * information[n:]
    inner = both[:, :n] + response * both[:, n:]
    return np.asarray(np.linalg.solve(inner + 1e-9 * np.trace(inner) / n * np.eye(n), both @ nodes))


def _square(moments: np.ndarray, response: float) -> np.ndarray:
    """Moments (..., 9, 9) as those (..., 6, 6) of a sensor whose vignetting follows its response."""
    return np.swapaxes(of_response(np.swapaxes(of_response(moments, response), -1, -2), response), -1, -2)


def _pooled(moments: np.ndarray) -> np.ndarray:
    """The channels' moments (..., 3, R, 6) as one, (..., R, 6): their errors are one and count once; what channels
    differ by is marginalized, or a change of color would be taken for one of the dark levels."""
    first, rows = moments[..., 0, :] / 3.0, moments[..., :, 0] / 3.0
    weight = _CONTRASTS.T @ (first[..., :1] * _CONTRASTS) + np.eye(2) / WHITE_SIGMA**2
    with_contrasts = np.swapaxes(rows, -1, -2) @ _CONTRASTS
    return np.asarray(moments.mean(axis=-3) - with_contrasts @ np.linalg.solve(weight, _CONTRASTS.T @ first))


def _white_balance(
    edges: PhotometricEdges, first: np.ndarray, lights: tuple[np.ndarray, np.ndarray], vignetting: np.ndarray,
    response: float,
) -> np.ndarray:  # fmt: skip
    """(K, 3) log gains of the channels over the image's, from what gains and lifts leave of each, by the first row
    (E, 3, 6) of the edges' moments; zeros if they do not show."""
    gains, lifts = lights
    a, b, n = edges.source, edges.to, len(gains)
    left = first[..., 5] - first[..., 2:5] @ vignetting
    left -= (gains[b] - gains[a])[:, None] * first[..., 0] + (lifts[b] - lifts[a])[:, None] * first[..., 1]
    left /= first[..., 0] + response * first[..., 1]  # a channel's gain has its lift, by the response
    left -= left.mean(axis=1, keepdims=True)
    own = 1.0 / first[..., 0].mean(axis=1)
    white, variance, trust = np.zeros((n, 3)), EDGE_SIGMA**2, np.ones(len(own))
    laplacian = np.zeros((n, n))
    for _ in range(4):
        strength = trust / (variance + own)
        laplacian, pull = np.zeros((n, n)), np.zeros((n, 3))
        for row, column, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
            np.add.at(laplacian, (row, column), sign * strength)
        np.add.at(pull, b, strength[:, None] * left)
        np.add.at(pull, a, -strength[:, None] * left)
        white = np.linalg.solve(laplacian + 1e-6 * strength.mean() * np.eye(n), pull)
        white -= white.mean(axis=0)
        off = left - (white[b] - white[a])
        rms = np.sqrt((off**2).sum(axis=1) / 2.0)
        variance = _edge_variance(rms, own, n)
        trust = 1.0 / (1.0 + rms**2 / (4.0 * (variance + own)))
    shown = float(np.einsum("ic,ij,jc", white, laplacian, white))
    shows = shown > 2 * (n - 1) * np.log(max(len(own), 3)) and change(white, np.zeros_like(white)) > STEP
    return white if shows else np.zeros((n, 3))


def _edge_variance(off: np.ndarray, own: np.ndarray, count: int) -> float:
    """Variance of what edges are off beyond their own (E,), from residuals (E,) of a graph of `count` images."""
    spare = max(len(off) - count + 1, 0)
    total = float(np.median(off**2)) / 0.4549 * len(off) / max(spare, 1)
    found = max(total - float(np.median(own)), 0.0)
    return (spare * found + _PRIOR_EDGES * EDGE_SIGMA**2) / (spare + _PRIOR_EDGES)


def _centered(information: np.ndarray) -> np.ndarray:
    """The information with that of the mean added, which the gauge gives."""
    return np.asarray(information + np.trace(information) / len(information) ** 2)


__all__ = ["STEP", "PhotometricCalibration", "PhotometricEdges", "solve_photometry"]
