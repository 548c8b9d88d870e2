"""Dense bundle adjustment in PyTorch: the same equations and the same steps as the C++ kernel, on any device.

All edges at once, float64 throughout. Sums over edges are matrix products, not scattered additions, so that a GPU too
gives the same result every time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mvsgs_core.devices import torch_device
from mvsgs_core.tracking.estimation.problem import Graph, Solution, Solver

_DENSE = 2**25  # elements of the coupling that are dense at a time: 256 MB


@dataclass
class _State:
    rotation: Tensor  # (K, 3, 3) camera from world
    translation: Tensor  # (K, 3)
    inverse_depth: Tensor  # (K, M)
    focal_factor: float


@dataclass
class _Normal:
    """The normal equations: reduced to poses and focal length, and what gives the inverse depths back."""

    cost: float
    reduced: Tensor  # (N, N)
    rhs: Tensor  # (N,)
    pose_coupling: Tensor  # (E, 6, M) of each edge's target pose
    focal_coupling: Tensor  # (K, M)
    adjoint: Tensor  # (E, 6, 6) of the edges' relative poses
    diagonal: Tensor  # (K, M)
    gradient: Tensor  # (K, M)


def adjust_with_torch(graph: Graph, solver: Solver, device: str) -> Solution:
    """`bundle_adjustment.adjust` by PyTorch on a device, "torch" for the CPU.

    Raises ValueError where CUDA is asked for and missing.
    """
    with torch.no_grad():
        return _Adjuster(graph, solver, find_device(device)).run()


def find_device(name: str) -> torch.device:
    """A PyTorch device by the name that `Solver.device` has. Raises ValueError where it is missing."""
    try:
        device = torch.device(torch_device(name))
    except RuntimeError:
        raise ValueError(f"bundle adjustment on {name}: there are cpu, cuda, cuda:0 and auto") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"bundle adjustment on {name}: PyTorch sees no CUDA device here; use tracker.device=cpu")
    return device


class _Adjuster:
    def __init__(self, graph: Graph, solver: Solver, device: torch.device) -> None:
        self.solver, self.device = solver, device
        k, m = graph.inverse_depth.shape
        order = np.lexsort((graph.to, graph.source))  # so that edges of one pair are neighbors, and of one source
        self.source, self.to = graph.source[order].astype(np.int64), graph.to[order].astype(np.int64)
        self.i, self.j = (torch.from_numpy(ends).to(device) for ends in (self.source, self.to))
        self.pixels = self._tensor(graph.pixels)
        self.target = self._tensor(graph.target[order])
        information = self._tensor(graph.weighed[order])
        self.wxx, self.wyy = information[:, 0], information[:, -1]
        self.wxy = information[:, 1] if information.shape[1] == 3 else torch.zeros_like(self.wxx)
        self.intrinsics = [float(v) for v in graph.intrinsics]
        self.focal = graph.free_focal
        used = np.isin(np.arange(k), np.concatenate([self.source, self.to]))
        self.free = np.flatnonzero(graph.free_pose & used)  # a pose without an edge keeps its place
        self.column = np.full(k, -1)
        self.column[self.free] = np.arange(len(self.free))
        self.depths = self._tensor(graph.free_depth & np.isin(np.arange(k), self.source))[:, None] > 0  # (K, 1)
        self.damping = self._tensor(np.full((k, m), 1e-6) if graph.damping is None else graph.damping)
        self.prior = None if graph.prior is None else self._tensor(graph.prior)
        self.prior_weight = None if graph.prior_weight is None else self._tensor(graph.prior_weight)
        self.by_source = self._selector(self.source, k)
        self.by_free_source = self._selector(self.column[self.source], len(self.free))
        self.by_free_to = self._selector(self.column[self.to], len(self.free))
        self.state = _State(
            self._tensor(graph.cam_from_world[:, :3, :3]),
            self._tensor(graph.cam_from_world[:, :3, 3]),
            self._tensor(graph.inverse_depth),
            1.0,
        )

    def run(self) -> Solution:
        """The loop of optimize.cpp."""
        solver, state = self.solver, self.state
        normal = self._linearize(state)
        initial = cost = normal.cost
        lm, rejected, steps, pivot, failure = solver.lm, 0, 0, 1.0, ""
        while steps < solver.steps:
            dx, pivot = self._solve(normal, lm)
            candidate = None if dx is None else self._retract(normal, dx, state)
            usable = candidate is not None and _finite(candidate)
            better = cost
            if usable and solver.adaptive:
                assert candidate is not None
                better = self._cost(candidate)
            if not usable or (solver.adaptive and not better <= cost):
                rejected += 1
                if not solver.adaptive or rejected > 6:
                    if dx is None:
                        failure = "the normal equations are not positive definite"
                    elif not usable:
                        failure = "a step was not finite"
                    break
                lm = max(10.0 * lm, 1e-6)
                continue
            assert candidate is not None
            rejected = 0
            if solver.adaptive:
                lm = max(lm / 5.0, 1e-9)
            gain, state, steps = cost - better, candidate, steps + 1
            done = solver.adaptive and gain <= solver.tolerance * cost
            cost = better
            if done or (steps == solver.steps and solver.adaptive):
                break
            normal = self._linearize(state)
            cost = normal.cost
        poses = np.tile(np.eye(4), (len(state.rotation), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = state.rotation.cpu().numpy(), state.translation.cpu().numpy()
        information = torch.where(self.depths, (normal.diagonal - self.damping).clamp(min=0.0), 0.0)
        return Solution(
            cam_from_world=poses,
            inverse_depth=state.inverse_depth.cpu().numpy(),
            information=information.cpu().numpy(),
            focal_factor=state.focal_factor,
            initial_cost=initial,
            cost=cost,
            steps=steps,
            smallest_pivot=pivot,
            failure=failure,
        )

    def _project(self, state: _State) -> tuple[Tensor, ...]:
        """Relative poses, rays (E, M), the points' 1/z, x/z, y/z, and the residuals (E, 2, M) and weights of edges."""
        ri, rj = state.rotation[self.i], state.rotation[self.j]
        r = rj @ ri.transpose(1, 2)
        t = state.translation[self.j] - (r @ state.translation[self.i][..., None])[..., 0]
        fx, fy, cx, cy = self._camera(state)
        x, y = (self.pixels[self.i, 0] - cx) / fx, (self.pixels[self.i, 1] - cy) / fy
        points = r @ torch.stack([x, y, torch.ones_like(x)], dim=1) + t[..., None] * state.inverse_depth[self.i, None]
        front = points[:, 2] >= self.solver.min_z
        q = 1.0 / torch.where(front, points[:, 2], 1.0)
        a, b = points[:, 0] * q, points[:, 1] * q
        counts = front & (self.wxx + self.wyy > 0)
        residual = self.target - torch.stack([fx * a + cx, fy * b + cy], dim=1)
        residual = torch.where(counts[:, None], residual, 0.0)
        weights = torch.where(counts, torch.stack([self.wxx, self.wxy, self.wyy]), 0.0)
        return r, t, x, y, q, a, b, residual, weights

    def _robust(self, residual: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Costs and the weights of iteratively reweighted least squares, each (E, M)."""
        ru, rv = residual[:, 0], residual[:, 1]
        s2 = weights[0] * ru * ru + 2.0 * weights[1] * ru * rv + weights[2] * rv * rv
        k2 = self.solver.robust_scale**2
        if self.solver.robust == "cauchy":
            g = 1.0 + s2 / k2
            return k2 * torch.log(g.clamp(max=1e15)), 1.0 / g
        return s2, torch.ones_like(s2)

    def _cost(self, state: _State) -> float:
        *_, residual, weights = self._project(state)
        return float(self._robust(residual, weights)[0].sum()) + self._prior_cost(state)

    def _prior_cost(self, state: _State) -> float:
        if self.prior is None or self.prior_weight is None:
            return 0.0
        return float((self.prior_weight * (state.inverse_depth - self.prior) ** 2).sum())

    def _linearize(self, state: _State) -> _Normal:
        r, t, x, y, q, a, b, residual, weights = self._project(state)
        costs, w = self._robust(residual, weights)
        wxx, wxy, wyy = weights * w
        fx, fy, *_ = self._camera(state)
        zero, dq, ab = torch.zeros_like(a), state.inverse_depth[self.i] * q, a * b
        ju = torch.stack([fx * dq, zero, -fx * a * dq, -fx * ab, fx * (1.0 + a * a), -fx * b], dim=1)
        jv = torch.stack([zero, fy * dq, -fy * b * dq, -fy * (1.0 + b * b), fy * ab, fy * a], dim=1)
        pu, pv = wxx[:, None] * ju + wxy[:, None] * jv, wxy[:, None] * ju + wyy[:, None] * jv
        hessian = ju @ pu.transpose(1, 2) + jv @ pv.transpose(1, 2)  # (E, 6, 6) of the target's pose
        gradient = (pu * residual[:, :1] + pv * residual[:, 1:]).sum(dim=2)
        tx, ty, tz = (t[:, n, None] for n in range(3))
        du, dv = fx * q * (tx - a * tz), fy * q * (ty - b * tz)
        wu, wv = wxx * du + wxy * dv, wxy * du + wyy * dv
        diagonal = self.by_source @ (du * wu + dv * wv) + self.damping
        depth_gradient = self.by_source @ (wu * residual[:, 0] + wv * residual[:, 1])
        if self.prior is not None and self.prior_weight is not None:
            diagonal = diagonal + self.prior_weight
            depth_gradient = depth_gradient - self.prior_weight * (state.inverse_depth - self.prior)
        coupling = pu * du[:, None] + pv * dv[:, None]
        adjoint = _adjoint(r, t)
        size = 6 * len(self.free) + self.focal
        reduced, rhs = self._pose_equations(hessian, gradient, adjoint, size)
        focal_coupling = torch.zeros_like(diagonal)
        if self.focal:  # its logarithm moves the ray in the source and the projection in the target
            back = -(r[:, :, :2] @ torch.stack([x, y], dim=1))
            fu, fv = fx * (a + q * (back[:, 0] - a * back[:, 2])), fy * (b + q * (back[:, 1] - b * back[:, 2]))
            with_pose = (pu * fu[:, None] + pv * fv[:, None]).sum(dim=2)[..., None]
            row = self.by_free_to @ with_pose[..., 0]
            row = row - self.by_free_source @ (adjoint.transpose(1, 2) @ with_pose)[..., 0]
            reduced[-1, :-1] = reduced[:-1, -1] = row.ravel()
            reduced[-1, -1] = (wxx * fu * fu + 2.0 * wxy * fu * fv + wyy * fv * fv).sum()
            pull = fu * (wxx * residual[:, 0] + wxy * residual[:, 1]) + fv * (
                wxy * residual[:, 0] + wyy * residual[:, 1]
            )
            rhs[-1] = pull.sum()
            focal_coupling = self.by_source @ (fu * wu + fv * wv)
        cost = float(costs.sum()) + self._prior_cost(state)
        normal = _Normal(cost, reduced, rhs, coupling, focal_coupling, adjoint, diagonal, depth_gradient)
        self._subtract_schur(normal)
        return normal

    def _pose_equations(self, hessian: Tensor, gradient: Tensor, adjoint: Tensor, size: int) -> tuple[Tensor, Tensor]:
        """J_i = -J_j Ad(T_ij): the sums for the target's pose give the blocks of both ends."""
        n = len(self.free)
        of_source = adjoint.transpose(1, 2) @ hessian  # (E, 6, 6)
        both = of_source @ adjoint
        blocks = torch.zeros(n, n, 6, 6, dtype=torch.float64, device=self.device)
        own = torch.arange(n, device=self.device)
        flat = self.by_free_to @ hessian.reshape(-1, 36) + self.by_free_source @ both.reshape(-1, 36)
        blocks[own, own] = flat.reshape(n, 6, 6)
        free = np.flatnonzero((self.column[self.source] >= 0) & (self.column[self.to] >= 0))
        row, column, crossed = self._merged(
            self.column[self.source][free], self.column[self.to][free], -of_source[free]
        )
        blocks[row, column] += crossed
        row, column = column, row  # the same pairs the other way: distinct within themselves, as before
        blocks[row, column] += crossed.transpose(1, 2)
        reduced = torch.zeros(size, size, dtype=torch.float64, device=self.device)
        reduced[: 6 * n, : 6 * n] = blocks.permute(0, 2, 1, 3).reshape(6 * n, 6 * n)
        rhs = torch.zeros(size, dtype=torch.float64, device=self.device)
        pulled = (adjoint.transpose(1, 2) @ gradient[..., None])[..., 0]
        rhs[: 6 * n] = (self.by_free_to @ gradient - self.by_free_source @ pulled).ravel()
        return reduced, rhs

    def _subtract_schur(self, normal: _Normal) -> None:
        """reduced -= E C^-1 E', rhs -= E C^-1 w, the dense coupling E of some keyframes at a time."""
        keyframes = np.flatnonzero(self.depths.cpu().numpy())
        n, m = len(self.free), normal.diagonal.shape[1]
        rows = len(normal.rhs)
        if rows == 0:
            return
        of_source = -(normal.adjoint.transpose(1, 2) @ normal.pose_coupling)  # (E, 6, M) of the source's own pose
        portion = max(1, _DENSE // (rows * m))
        for start in range(0, len(keyframes), portion):
            part = keyframes[start : start + portion]
            dense = torch.zeros(len(part), n, 6, m, dtype=torch.float64, device=self.device)
            place = np.full(len(normal.diagonal), -1)
            place[part] = np.arange(len(part))
            edges = np.flatnonzero((place[self.source] >= 0) & (self.column[self.to] >= 0))
            at, variable, values = self._merged(
                place[self.source[edges]], self.column[self.to[edges]], normal.pose_coupling[edges]
            )
            dense[at, variable] = values
            own = np.flatnonzero(self.column[part] >= 0)
            sums = torch.tensordot(self.by_source[part[own]], of_source, dims=1)
            dense[own, self.column[part[own]]] += sums
            block = dense.reshape(len(part), 6 * n, m)
            if self.focal:
                block = torch.cat([block, normal.focal_coupling[part][:, None]], dim=1)
            diagonal = normal.diagonal[part]
            inverse = torch.where(diagonal > 0, 1.0 / diagonal, 0.0)
            flat = block.transpose(0, 1).reshape(rows, -1)
            scaled = (block * inverse[:, None]).transpose(0, 1).reshape(rows, -1)
            normal.reduced -= scaled @ flat.T
            normal.rhs -= scaled @ normal.gradient[part].ravel()

    def _merged(self, first: np.ndarray, second: np.ndarray, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Sums of values (N, ...) over equal pairs, which must be neighbors; and those pairs."""
        pairs = np.stack([first, second], axis=1)
        starts = np.flatnonzero(np.any(np.diff(pairs, axis=0, prepend=-1), axis=1)) if len(pairs) else np.zeros(0, int)
        if len(starts) < len(pairs):
            lengths = torch.from_numpy(np.diff(starts, append=len(pairs))).to(self.device)
            values = torch.segment_reduce(values.contiguous(), "sum", lengths=lengths, axis=0)
        rows, columns = (torch.from_numpy(pairs[starts, n]).to(self.device) for n in (0, 1))
        return rows, columns, values

    def _solve(self, normal: _Normal, lm: float) -> tuple[Tensor | None, float]:
        """The step of poses and focal length, None where there is none; and the smallest relative pivot."""
        if len(normal.rhs) == 0:
            return normal.rhs, 1.0
        diagonal = normal.reduced.diagonal()
        damped = normal.reduced + torch.diag(self.solver.ep + lm * diagonal.clamp(min=0.0))
        factor, info = torch.linalg.cholesky_ex(damped)
        pivot = float((factor.diagonal() ** 2 / damped.diagonal()).min())
        if int(info) or not pivot > 1e-14:
            return None, min(pivot, 0.0) if np.isfinite(pivot) and not int(info) else -1.0
        return torch.cholesky_solve(normal.rhs[:, None], factor)[:, 0], min(pivot, 1.0)

    def _retract(self, normal: _Normal, dx: Tensor, state: _State) -> _State:
        n = len(self.free)
        twists = torch.zeros(len(state.rotation), 6, dtype=torch.float64, device=self.device)
        twists[self.free] = dx[: 6 * n].reshape(n, 6)
        seen = twists[self.j] - (normal.adjoint @ twists[self.i][..., None])[..., 0]  # (E, 6) what moves each edge
        step = normal.gradient - self.by_source @ (seen[:, None] @ normal.pose_coupling)[:, 0]
        factor = state.focal_factor
        if self.focal:
            step = step - normal.focal_coupling * dx[-1]
            factor *= float(np.exp(float(dx[-1])))
        positive = self.depths & (normal.diagonal > 0)
        moved = (state.inverse_depth + step / torch.where(positive, normal.diagonal, 1.0)).clamp(
            min=self.solver.min_inverse_depth
        )
        depths = torch.where(positive, moved, state.inverse_depth)
        rotation, translation = state.rotation.clone(), state.translation.clone()
        turn, shift = _se3_exp(twists[self.free])
        rotation[self.free] = turn @ state.rotation[self.free]
        translation[self.free] = (turn @ state.translation[self.free][..., None])[..., 0] + shift
        return _State(rotation, translation, depths, factor)

    def _camera(self, state: _State) -> tuple[float, float, float, float]:
        fx, fy, cx, cy = self.intrinsics
        return fx * state.focal_factor, fy * state.focal_factor, cx, cy

    def _selector(self, rows: np.ndarray, count: int) -> Tensor:
        """(count, E): ones where an edge belongs to a row; edges of row -1 belong to none."""
        return self._tensor(rows[None] == np.arange(count)[:, None])

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64)).to(self.device)


def _adjoint(r: Tensor, t: Tensor) -> Tensor:
    """(E, 6, 6) [R, [t]x R; 0, R] for twists (translation, rotation)."""
    result = torch.zeros(len(r), 6, 6, dtype=r.dtype, device=r.device)
    result[:, :3, :3] = result[:, 3:, 3:] = r
    result[:, :3, 3:] = _skew(t) @ r
    return result


def _se3_exp(twists: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (N, 3, 3) and translations (N, 3) of twists (N, 6)."""
    k = _skew(twists[:, 3:])
    angle = twists[:, 3:].norm(dim=1)[:, None, None]
    small, t2 = angle < 1e-4, angle**2
    safe = torch.where(small, 1.0, angle)
    a = torch.where(small, 1.0 - t2 / 6.0, torch.sin(safe) / safe)
    b = torch.where(small, 0.5 - t2 / 24.0, (1.0 - torch.cos(safe)) / safe**2)
    c = torch.where(small, 1.0 / 6.0 - t2 / 120.0, (safe - torch.sin(safe)) / safe**3)
    eye = torch.eye(3, dtype=twists.dtype, device=twists.device)
    shift = (eye + b * k + c * (k @ k)) @ twists[:, :3, None]
    return eye + a * k + b * (k @ k), shift[..., 0]


def _skew(v: Tensor) -> Tensor:
    """(N, 3, 3) cross product matrices of (N, 3)."""
    x, y, z = v.unbind(dim=1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)


def _finite(state: _State) -> bool:
    arrays = (state.rotation, state.translation, state.inverse_depth)
    return all(bool(torch.isfinite(a).all()) for a in arrays) and np.isfinite(state.focal_factor)


__all__ = ["adjust_with_torch", "find_device"]
