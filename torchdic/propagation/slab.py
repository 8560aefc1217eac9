"""One slab of the split step, to first or second order, with its derivative written out.

V is the spectrum of each source's envelope half a slab in front of a screen, and H what the light does between this
screen and the next one. The screen is φ = c·B/(R + p_z0) with R = √(p_z0² + B), c = k0 dz and B = n² − n0². F and F⁻¹
are `to_spectrum` and `to_field`. To first order g is G², to second order G² − 1:

    order 1:  V' = H·[V + g·X],      X = F[(e − 1)·f],   f = F⁻¹V                                        e = exp(iφ)
    order 2:  V' = H·F[e·(u + a)],   a = F⁻¹[g·X],       X = F[iφ·u],   u = e·F⁻¹V                     e = exp(iφ/2)

V' is holomorphic in φ, V, H and g, and F and F⁻¹ are their own transposes. Let a bar denote the complex conjugate of
torch's gradient. Then it is carried back by the same products and transforms:

    order 1:  Y = H·V̄',  A = F[g·Y],   φ̄ = Σ ie·f·A,   V̄ = Y + F⁻¹[(e − 1)·A],   ḡ = X·Y,   H̄ = V̄'·[V + g·X]
    order 2:  r = e·F[H·V̄'],  q = F⁻¹r,  t = F[g·q],  ū = r + iφ·t,
              φ̄ = Σ i·[½(u + a)·r + ½u·ū + u·t],   V̄ = F⁻¹[e·ū],   ḡ = X·q,   H̄ = V̄'·F[e·(u + a)]

Σ sums over the sources that a screen is for. As φ = c·(R − p_z0), B̄ = c·φ̄/(2R) and p̄_z0 = −φ·φ̄/R. Sources are taken
in parts that the CPU's caches hold. The backward pass computes the screens again, so only f is kept, or u and u + a.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from jaxtyping import Complex, Float, Inexact
from torch import Tensor

from torchdic.memory.batches import in_cache, once
from torchdic.plane_waves import exp_i, to_field, to_spectrum

# How many consecutive sources have each screen in common; None where each source has its own.
Screens = list[int] | None


class Slab(NamedTuple):
    """What slabs have in common.

    order: 1 or 2, in φ.
    depth: c = k0 dz.
    screens: how many sources share each screen, see `Screens`.
    """

    order: int
    depth: float
    screens: Screens


def cross_slab(
    slab: Slab,
    B: Inexact[Tensor, "y x"],
    pz0: Float[Tensor, "screen 1 1"],
    V: Complex[Tensor, "source y x"],
    H: Complex[Tensor, "source y x"],
    g: Complex[Tensor, "source y x"],
) -> Complex[Tensor, "source y x"]:
    """V' of the module's docstring. It is differentiable once, in B, p_z0, V, H and g.

    slab: the order, and which sources share a screen.
    B: n² − n0²; complex where light is absorbed.
    pz0: p_z0 of each screen.
    """
    function = _FirstOrder if slab.order == 1 else _SecondOrder
    return function.apply(slab, B, pz0, V, H, g)  # pyright: ignore[reportReturnType]


class _FirstOrder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, slab: Slab, B: Tensor, pz0: Tensor, V: Tensor, H: Tensor, g: Tensor) -> Tensor:
        phi, _ = _screen(slab, B, pz0)
        weak, result, kept = exp_i(phi) - 1, torch.empty_like(V), []
        for part, its in _parts(V, slab.screens):
            f = to_field(V[part])
            X = to_spectrum(weak[its] * f)
            torch.mul(X.mul_(g[part]).add_(V[part]), H[part], out=result[part])
            kept += [f] if any(ctx.needs_input_grad) else []
        own = V if ctx.needs_input_grad[4] else None
        ctx.save_for_backward(B, pz0, own, H, g, *kept)
        ctx.slab = slab
        return result

    @staticmethod
    @once
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        B, pz0, V, H, g, *kept = ctx.saved_tensors
        phi, root = _screen(ctx.slab, B, pz0)
        e = exp_i(phi)
        bar, weak, summed, V_bar = result_bar.conj(), e - 1, torch.zeros_like(e), torch.empty_like(H)
        H_bar, g_bar = (torch.empty_like(H) if needed else None for needed in ctx.needs_input_grad[4:])
        for (part, its), f in zip(_parts(H, ctx.slab.screens), kept, strict=True):
            Y = H[part] * bar[part]
            A = to_spectrum(g[part] * Y)
            _add(summed, its, f * A)
            torch.add(to_field(A.mul_(weak[its])), Y, out=V_bar[part])
            if H_bar is not None or g_bar is not None:
                X = to_spectrum(weak[its] * f)
                if g_bar is not None:
                    g_bar[part] = X * Y
                if H_bar is not None:
                    H_bar[part] = bar[part] * (V[part] + g[part] * X)
        screen_bar = _screen_bar(ctx.slab, B, phi, root, 1j * e * summed)
        return None, *screen_bar, *(None if b is None else b.conj() for b in (V_bar, H_bar, g_bar))


class _SecondOrder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, slab: Slab, B: Tensor, pz0: Tensor, V: Tensor, H: Tensor, g: Tensor) -> Tensor:
        phi, _ = _screen(slab, B, pz0)
        e, i_phi, result, kept = exp_i(phi / 2), 1j * phi, torch.empty_like(V), []
        for part, its in _parts(V, slab.screens):
            u = to_field(V[part]).mul_(e[its])
            both = to_field(to_spectrum(i_phi[its] * u).mul_(g[part])).add_(u)
            torch.mul(to_spectrum(e[its] * both), H[part], out=result[part])
            kept += [u, both] if any(ctx.needs_input_grad) else []
        ctx.save_for_backward(B, pz0, H, g, *kept)
        ctx.slab = slab
        return result

    @staticmethod
    @once
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        B, pz0, H, g, *kept = ctx.saved_tensors
        phi, root = _screen(ctx.slab, B, pz0)
        e, i_phi = exp_i(phi / 2), 1j * phi
        bar, summed, V_bar = result_bar.conj(), torch.zeros_like(e), torch.empty_like(H)
        H_bar, g_bar = (torch.empty_like(H) if needed else None for needed in ctx.needs_input_grad[4:])
        for (part, its), u, both in zip(_parts(H, ctx.slab.screens), kept[::2], kept[1::2], strict=True):
            r = to_spectrum(H[part] * bar[part]).mul_(e[its])
            q = to_field(r)
            t = to_spectrum(g[part] * q)
            u_bar = (i_phi[its] * t).add_(r)
            _add(summed, its, (r * both).add_(t.mul_(2).add_(u_bar).mul_(u)))
            V_bar[part] = to_field(u_bar.mul_(e[its]))
            if g_bar is not None:
                g_bar[part] = to_spectrum(i_phi[its] * u) * q
            if H_bar is not None:
                H_bar[part] = bar[part] * to_spectrum(e[its] * both)
        screen_bar = _screen_bar(ctx.slab, B, phi, root, 0.5j * summed)
        return None, *screen_bar, *(None if b is None else b.conj() for b in (V_bar, H_bar, g_bar))


def _screen(slab: Slab, B: Tensor, pz0: Tensor) -> tuple[Tensor, Tensor]:
    """φ and R of each screen."""
    root = _root(pz0.square() + B)
    return slab.depth * B / (root + pz0), root


def _screen_bar(slab: Slab, B: Tensor, phi: Tensor, root: Tensor, phi_bar: Tensor) -> tuple[Tensor, Tensor]:
    """The gradients, as torch has them, to B and p_z0."""
    if not B.is_complex():
        phi_bar = phi_bar.real
    ratio = phi_bar / root
    return (slab.depth / 2 * ratio).sum(0).conj(), -(phi * ratio).real.sum((1, 2), keepdim=True)


def _root(square: Tensor) -> Tensor:
    """The root of real numbers, or of complex numbers that aren't 0, six times as fast as torch.sqrt of these."""
    if not square.is_complex():
        return square.sqrt()
    # the larger part first, so that nothing cancels
    larger = ((square.abs() + square.real.abs()) / 2).sqrt()
    smaller = square.imag.abs() / (2 * larger)
    forward = square.real >= 0
    imaginary = torch.where(forward, smaller, larger)
    return torch.complex(torch.where(forward, larger, smaller), imaginary.copysign(square.imag))


def _parts(V: Tensor, screens: Screens) -> Iterator[tuple[slice, slice | Tensor]]:
    """The sources in parts, and the screens of each part: a single one, or one for each source."""
    parts = in_cache(V)
    if screens is None:
        yield from ((part, part) for part in parts)
    elif len(parts) == 1:  # few pixels: a call for each screen would take longer than copies of the screens
        yield parts[0], torch.arange(len(screens)).repeat_interleave(torch.tensor(screens))
    else:
        first = 0
        for screen, count in enumerate(screens):
            for part in in_cache(V[first : first + count]):
                yield slice(first + part.start, first + part.stop), slice(screen, screen + 1)
            first += count


def _add(summed: Tensor, its: slice | Tensor, values: Tensor) -> None:
    """Add the sources' values to those of their screens."""
    if isinstance(its, Tensor):
        summed.index_add_(0, its, values)
    else:
        summed[its] += values if len(summed[its]) == len(values) else values.sum(0)
