"""Ways to trace rays through a volume of index, all by the same RK4 steps. rays.py times them.

Each way is a class made from Δn (z, y, x) in float32. `forward()` returns how far rays landed from where they would
have landed without the specimen (y, x; ray), and their OPD. If the way can do it, `gradient()` returns ∂/∂Δn of Σ OPD².
All ways sample Δn and its central differences linearly between voxel centres. Rays start from every voxel's (y, x) on
the first face in one direction.
"""

# the rivals are optional packages
# pyright: reportMissingImports=false

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

BACKGROUND = 1.36
VOXEL = 0.1  # µm
DIRECTION = (0.2, -0.1)  # n·sinθ, (y, x)


def start(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Position and momentum (2, ray) of each ray on the first face."""
    y, x = ((np.arange(n) - (n - 1) / 2) * VOXEL for n in shape[1:])
    position = np.stack(np.meshgrid(y, x, indexing="ij")).reshape(2, -1).astype(np.float32)
    momentum = np.repeat(np.array(DIRECTION, np.float32)[:, None], position.shape[1], 1)
    return position, momentum


class Torchdic:
    """torchdic.trace, which keeps everything if it fits the default memory budget."""

    budget = 1 << 34

    def __init__(self, delta: np.ndarray, steps: int) -> None:
        import torch

        from torchdic import Fidelity, Grid, Rays, Volume

        position, momentum = (torch.from_numpy(v).T.contiguous() for v in start(delta.shape))
        self.delta = torch.nn.Parameter(torch.from_numpy(delta))
        nz, ny, nx = delta.shape
        self.volume = Volume(Grid((nz, ny, nx), (VOXEL, VOXEL, VOXEL)), self.delta, BACKGROUND)
        self.rays = Rays(position, momentum, position.new_zeros(len(position)))
        self.fidelity = Fidelity("rays", steps=steps, memory=self.budget)

    def run(self):
        """Deviation and OPD as tensors."""
        from torchdic.rays.trace import deviation

        change = deviation(self.volume.sampled(self.fidelity.interpolation), self.rays, self.fidelity)
        return change.position.T, change.opd

    def forward(self) -> tuple[np.ndarray, np.ndarray]:
        """Deviation (2, ray) and OPD (ray)."""
        import torch

        with torch.no_grad():
            moved, opd = self.run()
        return moved.cpu().numpy(), opd.cpu().numpy()

    def gradient(self) -> np.ndarray:
        """∂/∂Δn of Σ OPD²."""
        self.delta.grad = None
        self.run()[1].square().sum().backward()
        assert self.delta.grad is not None
        return self.delta.grad.cpu().numpy()


class TorchdicRecomputing(Torchdic):
    """Like Torchdic with a budget too small to keep a step: the backward pass computes slabs again."""

    budget = 1


class _Torchdiffeq(ABC):
    """A straightforward use of torchdiffeq: state (y, x, p_y, p_x, W) and an index tensor that requires grad."""

    def __init__(self, delta: np.ndarray, steps: int) -> None:
        import torch

        self.delta = torch.nn.Parameter(torch.from_numpy(delta))
        position, momentum = (torch.from_numpy(v) for v in start(delta.shape))
        self.position, self.momentum = position, momentum
        self.state = torch.cat((position, momentum, torch.zeros_like(position[:1])))
        nz, ny, nx = delta.shape
        self.half = nz * VOXEL / 2
        self.z = torch.linspace(-self.half, self.half, steps + 1)
        self.scale = [2 / (VOXEL * (n - 1)) for n in (nx, ny, nz)]
        self.pz0 = math.sqrt(BACKGROUND**2 - sum(p * p for p in DIRECTION))

    @abstractmethod
    def sampler(self) -> Callable:
        """(z, y, x) → Δn, ∂Δn/∂y, ∂Δn/∂x."""

    def run(self):
        """Deviation and OPD as tensors."""
        from torchdiffeq import odeint

        sample = self.sampler()

        def slope(z, state):
            import torch

            y, x, py, px, _ = state
            delta, gy, gx = sample(z, y, x)
            n = BACKGROUND + delta
            pz = (n * n - py * py - px * px).sqrt()
            contrast = delta * (2 * BACKGROUND + delta)
            dy, dx = py - DIRECTION[0], px - DIRECTION[1]
            q = pz - self.pz0
            opd = (contrast + dy * dy + dx * dx + q * q) / (2 * pz)
            return torch.stack((py / pz, px / pz, n * gy / pz, n * gx / pz, opd))

        end = odeint(
            slope, self.state, self.z[[0, -1]], method="rk4", options={"step_size": float(self.z[1] - self.z[0])}
        )[-1]
        straight = self.position + self.momentum / self.pz0 * (2 * self.half)
        return end[:2] - straight, end[4]

    forward = Torchdic.forward
    gradient = Torchdic.gradient


class Torchdiffeq3d(_Torchdiffeq):
    """torchdiffeq with one 3-D grid_sample of (Δn, ∇Δn) per evaluation."""

    def sampler(self) -> Callable:
        """(z, y, x) → Δn, ∂Δn/∂y, ∂Δn/∂x."""
        import torch
        import torch.nn.functional as F

        gz, gy, gx = torch.gradient(self.delta, spacing=VOXEL)
        channels = torch.stack((self.delta, gz, gy, gx))[None]

        def sample(z, y, x):
            where = torch.stack(
                (x * self.scale[0], y * self.scale[1], torch.broadcast_to(z * self.scale[2], x.shape)), -1
            )
            values = F.grid_sample(channels, where[None, None, None], padding_mode="border", align_corners=True)
            return values[0, [0, 2, 3], 0, 0]

        return sample


class Torchdiffeq2d(_Torchdiffeq):
    """torchdiffeq with a 2-D grid_sample in the slice blended for the current depth."""

    def sampler(self) -> Callable:
        """(z, y, x) → Δn, ∂Δn/∂y, ∂Δn/∂x."""
        import torch
        import torch.nn.functional as F

        slices = self.delta.unbind(0)

        def sample(z, y, x):
            at = min(max(float(z) / VOXEL + (len(slices) - 1) / 2, 0), len(slices) - 1)
            base = min(int(at), len(slices) - 2)
            blend = (1 - (at - base)) * slices[base] + (at - base) * slices[base + 1]
            padded = F.pad(blend[None], (1, 1, 1, 1), mode="replicate")[0]
            gy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * VOXEL)
            gx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * VOXEL)
            where = torch.stack((x * self.scale[0], y * self.scale[1]), -1)[None, None]
            channels = torch.stack((blend, gy, gx))[None]
            return F.grid_sample(channels, where, padding_mode="border", align_corners=True)[0, :, 0]

        return sample


class Diffrax:
    """diffrax on JAX, jitted, slice by slice: an ODE solve through each slab, recursively checkpointed."""

    def __init__(self, delta: np.ndarray, steps: int) -> None:
        import diffrax
        import jax
        import jax.numpy as jnp

        self.delta = jnp.asarray(delta)
        position, momentum = (jnp.asarray(v) for v in start(delta.shape))
        nz, ny, nx = delta.shape
        half = nz * VOXEL / 2
        pz0 = math.sqrt(BACKGROUND**2 - sum(p * p for p in DIRECTION))
        straight = position + momentum / pz0 * (2 * half)

        def bilinear(field, y, x):
            iy, ix = (jnp.clip(v / VOXEL + (n - 1) / 2, 0, n - 1) for v, n in ((y, ny), (x, nx)))
            by, bx = (jnp.clip(jnp.floor(i).astype(jnp.int32), 0, n - 2) for i, n in ((iy, ny), (ix, nx)))
            ty, tx = iy - by, ix - bx
            flat, corner = field.reshape(3, -1), by * nx + bx
            top = flat[:, corner] * (1 - tx) + flat[:, corner + 1] * tx
            bottom = flat[:, corner + nx] * (1 - tx) + flat[:, corner + nx + 1] * tx
            return top * (1 - ty) + bottom * ty

        def slope(z, state, delta):
            y, x, py, px, _ = state
            at = jnp.clip(z / VOXEL + (nz - 1) / 2, 0, nz - 1)
            base = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, nz - 2)
            t = at - base
            blend = (1 - t) * delta[base] + t * delta[base + 1]
            padded = jnp.pad(blend, 1, mode="edge")
            gy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * VOXEL)
            gx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * VOXEL)
            d, gy, gx = bilinear(jnp.stack((blend, gy, gx)), y, x)
            n = BACKGROUND + d
            pz = jnp.sqrt(n * n - py * py - px * px)
            dy, dx, q = py - DIRECTION[0], px - DIRECTION[1], pz - pz0
            opd = (d * (2 * BACKGROUND + d) + dy * dy + dx * dx + q * q) / (2 * pz)
            return jnp.stack((py / pz, px / pz, n * gy / pz, n * gx / pz, opd))

        # diffrax has no classical RK4, but takes a tableau
        rk4 = diffrax.ButcherTableau(
            a_lower=(np.array([1 / 2]), np.array([0, 1 / 2]), np.array([0, 0, 1.0])),
            b_sol=np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6]),
            b_error=np.zeros(4),
            c=np.array([1 / 2, 1 / 2, 1.0]),
        )

        class RK4(diffrax.AbstractERK):
            tableau = rk4
            interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

            def order(self, terms):
                return 4

        def run(delta):
            state = jnp.concatenate((position, momentum, jnp.zeros_like(position[:1])))
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(slope), RK4(), -half, half, None, state, args=delta, max_steps=steps + 1,
                stepsize_controller=diffrax.StepTo(ts=jnp.linspace(-half, half, steps + 1)),
                adjoint=diffrax.RecursiveCheckpointAdjoint(),
            )  # fmt: skip
            assert solution.ys is not None
            end = solution.ys[-1]
            return end[:2] - straight, end[4]

        self._forward = jax.jit(run)
        self._gradient = jax.jit(jax.grad(lambda delta: (run(delta)[1] ** 2).sum()))

    def forward(self) -> tuple[np.ndarray, np.ndarray]:
        """Deviation (2, ray) and OPD (ray)."""
        moved, opd = self._forward(self.delta)
        return np.asarray(moved), np.asarray(opd)

    def gradient(self) -> np.ndarray:
        """∂/∂Δn of Σ OPD²."""
        return np.asarray(self._gradient(self.delta))


class Numba:
    """A fused loop over rays, compiled by numba for all cores: about the shortest forward pass on a CPU."""

    def __init__(self, delta: np.ndarray, steps: int) -> None:
        import numba

        self.delta, self.steps = delta, steps
        self.position, self.momentum = start(delta.shape)
        nz, ny, nx = delta.shape
        n0, voxel, (py0, px0) = BACKGROUND, VOXEL, DIRECTION
        pz0 = math.sqrt(n0 * n0 - py0 * py0 - px0 * px0)

        @numba.njit(parallel=True, fastmath=True)
        def channels(delta, z):
            at = min(max(z / voxel + (nz - 1) / 2, 0.0), nz - 1.0)
            base = min(int(at), nz - 2)
            t = np.float32(at - base)
            blend = np.empty((ny, nx), np.float32)
            out = np.empty((ny, nx, 3), np.float32)
            for i in numba.prange(ny):
                for j in range(nx):
                    blend[i, j] = (1 - t) * delta[base, i, j] + t * delta[base + 1, i, j]
            scale = np.float32(1 / (2 * voxel))
            for i in numba.prange(ny):
                up, down = min(i + 1, ny - 1), max(i - 1, 0)
                for j in range(nx):
                    out[i, j, 0] = blend[i, j]
                    out[i, j, 1] = (blend[up, j] - blend[down, j]) * scale
                    out[i, j, 2] = (blend[i, min(j + 1, nx - 1)] - blend[i, max(j - 1, 0)]) * scale
            return out

        @numba.njit(fastmath=True, inline="always")
        def slope(field, y, x, py, px):
            one = np.float32(1)
            iy = min(max(y * np.float32(1 / voxel) + np.float32((ny - 1) / 2), np.float32(0)), np.float32(ny - 1))
            ix = min(max(x * np.float32(1 / voxel) + np.float32((nx - 1) / 2), np.float32(0)), np.float32(nx - 1))
            by, bx = min(int(iy), ny - 2), min(int(ix), nx - 2)
            ty, tx = iy - np.float32(by), ix - np.float32(bx)
            a, b = (one - ty) * (one - tx), (one - ty) * tx
            c, d = ty * (one - tx), ty * tx
            f00, f01, f10, f11 = field[by, bx], field[by, bx + 1], field[by + 1, bx], field[by + 1, bx + 1]
            delta = a * f00[0] + b * f01[0] + c * f10[0] + d * f11[0]
            gy = a * f00[1] + b * f01[1] + c * f10[1] + d * f11[1]
            gx = a * f00[2] + b * f01[2] + c * f10[2] + d * f11[2]
            n = np.float32(n0) + delta
            pz = np.sqrt(n * n - py * py - px * px)
            r = one / pz
            dy, dx, q = py - np.float32(py0), px - np.float32(px0), pz - np.float32(pz0)
            opd = (delta * (np.float32(2 * n0) + delta) + dy * dy + dx * dx + q * q) * np.float32(0.5) * r
            return py * r, px * r, n * gy * r, n * gx * r, opd

        @numba.njit(parallel=True, fastmath=True)
        def step(first, middle, last, state, h):
            half, sixth = np.float32(h / 2), np.float32(h / 6)
            for i in numba.prange(state.shape[1]):
                y, x, py, px, w = state[0, i], state[1, i], state[2, i], state[3, i], state[4, i]
                ay, ax, apy, apx, aw = slope(first, y, x, py, px)
                by, bx, bpy, bpx, bw = slope(middle, y + half * ay, x + half * ax, py + half * apy, px + half * apx)
                cy, cx, cpy, cpx, cw = slope(middle, y + half * by, x + half * bx, py + half * bpy, px + half * bpx)
                dy, dx, dpy, dpx, dw = slope(
                    last, y + 2 * half * cy, x + 2 * half * cx, py + 2 * half * cpy, px + 2 * half * cpx
                )
                state[0, i] = y + sixth * (ay + 2 * by + 2 * cy + dy)
                state[1, i] = x + sixth * (ax + 2 * bx + 2 * cx + dx)
                state[2, i] = py + sixth * (apy + 2 * bpy + 2 * cpy + dpy)
                state[3, i] = px + sixth * (apx + 2 * bpx + 2 * cpx + dpx)
                state[4, i] = w + sixth * (aw + 2 * bw + 2 * cw + dw)

        self._channels, self._step, self._pz0 = channels, step, pz0

    def forward(self) -> tuple[np.ndarray, np.ndarray]:
        """Deviation (2, ray) and OPD (ray)."""
        state = np.concatenate((self.position, self.momentum, np.zeros_like(self.position[:1])))
        half = len(self.delta) * VOXEL / 2
        h = 2 * half / self.steps
        first = self._channels(self.delta, -half)
        for i in range(self.steps):
            middle = self._channels(self.delta, -half + (i + 0.5) * h)
            last = self._channels(self.delta, -half + (i + 1) * h)
            self._step(first, middle, last, state, h)
            first = last
        return state[:2] - self.position - self.momentum / np.float32(self._pz0) * np.float32(2 * half), state[4]
