"""One slab of the split step, to first or second order, with its derivative written out.

V is the spectrum of each source's envelope half a slab in front of a screen, and H what the light does between this
screen and the next one. F and F⁻¹ are `to_spectrum` and `to_field`. To first order g is G², to second order G² − 1:

    order 1:  V' = H·[V + g·X],      X = F[(e − 1)·f],   f = F⁻¹V                                        e = exp(iφ)
    order 2:  V' = H·F[e·(u + a)],   a = F⁻¹[g·X],       X = F[iφ·u],   u = e·F⁻¹V                     e = exp(iφ/2)

V' is holomorphic in φ, V, H and g, and F and F⁻¹ are their own transposes. Let a bar denote the complex conjugate of
torch's gradient. Then it is carried back by the same products and transforms:

    order 1:  Y = H·V̄',  A = F[g·Y],   φ̄ = Σ ie·f·A,   V̄ = Y + F⁻¹[(e − 1)·A],   ḡ = X·Y,   H̄ = V̄'·[V + g·X]
    order 2:  r = e·F[H·V̄'],  q = F⁻¹r,  t = F[g·q],  ū = r + iφ·t,
              φ̄ = Σ i·[½(u + a)·r + ½u·ū + u·t],   V̄ = F⁻¹[e·ū],   ḡ = X·q,   H̄ = V̄'·F[e·(u + a)]

Σ sums over the sources that a screen is for. Sources are taken in parts that the CPU's caches hold.
"""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Complex, Inexact
from torch import Tensor

from torchdic.memory.batches import in_cache, once
from torchdic.plane_waves import exp_i, to_field, to_spectrum

# How many consecutive sources have each screen in common; None where each source has its own.
Screens = list[int] | None


def cross_slab(
    order: int,
    phi: Inexact[Tensor, "screen y x"],
    V: Complex[Tensor, "source y x"],
    H: Complex[Tensor, "source y x"],
    g: Complex[Tensor, "source y x"],
    screens: Screens,
) -> Complex[Tensor, "source y x"]:
    """V' of the module's docstring. It is differentiable once, in φ, V, H and g.

    order: 1 or 2, in φ.
    phi: φ of each screen in rad; complex where light is absorbed.
    screens: how many sources share each screen, see `Screens`.
    """
    slab = _FirstOrder if order == 1 else _SecondOrder
    return slab.apply(phi, V, H, g, screens)  # pyright: ignore[reportReturnType]


class _FirstOrder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, phi: Tensor, V: Tensor, H: Tensor, g: Tensor, screens: Screens) -> Tensor:
        e, result, kept = exp_i(phi), torch.empty_like(V), []
        weak = e - 1
        for part, its in _parts(V, screens):
            f = to_field(V[part])
            X = to_spectrum(weak[its] * f)
            torch.mul(X.mul_(g[part]).add_(V[part]), H[part], out=result[part])
            kept += [f] if any(ctx.needs_input_grad) else []
        own = V if ctx.needs_input_grad[2] else None
        ctx.save_for_backward(e, own, H, g, *kept)
        ctx.screens, ctx.real = screens, not phi.is_complex()
        return result

    @staticmethod
    @once
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        e, V, H, g, *kept = ctx.saved_tensors
        bar, weak, summed = result_bar.conj(), e - 1, torch.zeros_like(e)
        V_bar = torch.empty_like(H)
        H_bar, g_bar = (torch.empty_like(H) if needed else None for needed in ctx.needs_input_grad[2:4])
        for (part, its), f in zip(_parts(H, ctx.screens), kept, strict=True):
            Y = H[part] * bar[part]
            A = to_spectrum(g[part] * Y)
            _add(summed[its], f * A)
            torch.add(to_field(A.mul_(weak[its])), Y, out=V_bar[part])
            if H_bar is not None or g_bar is not None:
                X = to_spectrum(weak[its] * f)
                if g_bar is not None:
                    g_bar[part] = X * Y
                if H_bar is not None:
                    H_bar[part] = bar[part] * (V[part] + g[part] * X)
        return _gradients(1j * e * summed, V_bar, H_bar, g_bar, real=ctx.real)


class _SecondOrder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, phi: Tensor, V: Tensor, H: Tensor, g: Tensor, screens: Screens) -> Tensor:
        e, i_phi, result, kept = exp_i(phi / 2), 1j * phi, torch.empty_like(V), []
        for part, its in _parts(V, screens):
            u = to_field(V[part]).mul_(e[its])
            both = to_field(to_spectrum(i_phi[its] * u).mul_(g[part])).add_(u)
            torch.mul(to_spectrum(e[its] * both), H[part], out=result[part])
            kept += [u, both] if any(ctx.needs_input_grad) else []
        ctx.save_for_backward(e, i_phi, H, g, *kept)
        ctx.screens, ctx.real = screens, not phi.is_complex()
        return result

    @staticmethod
    @once
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        e, i_phi, H, g, *kept = ctx.saved_tensors
        bar, summed, V_bar = result_bar.conj(), torch.zeros_like(e), torch.empty_like(H)
        H_bar, g_bar = (torch.empty_like(H) if needed else None for needed in ctx.needs_input_grad[2:4])
        for (part, its), u, both in zip(_parts(H, ctx.screens), kept[::2], kept[1::2], strict=True):
            r = to_spectrum(H[part] * bar[part]).mul_(e[its])
            q = to_field(r)
            t = to_spectrum(g[part] * q)
            u_bar = (i_phi[its] * t).add_(r)
            _add(summed[its], (r * both).add_(t.mul_(2).add_(u_bar).mul_(u)))
            V_bar[part] = to_field(u_bar.mul_(e[its]))
            if g_bar is not None:
                g_bar[part] = to_spectrum(i_phi[its] * u) * q
            if H_bar is not None:
                H_bar[part] = bar[part] * to_spectrum(e[its] * both)
        return _gradients(0.5j * summed, V_bar, H_bar, g_bar, real=ctx.real)


def _parts(V: Tensor, screens: Screens) -> Iterator[tuple[slice, slice]]:
    """The sources in parts, and the screens of each part: a single one, or one for each source."""
    if screens is None:
        yield from ((part, part) for part in in_cache(V))
        return
    first = 0
    for screen, count in enumerate(screens):
        for part in in_cache(V[first : first + count]):
            yield slice(first + part.start, first + part.stop), slice(screen, screen + 1)
        first += count


def _add(summed: Tensor, values: Tensor) -> None:
    """Add the sources' values to those of their screens."""
    summed += values if len(summed) == len(values) else values.sum(0)


def _gradients(
    phi_bar: Tensor, V_bar: Tensor, H_bar: Tensor | None, g_bar: Tensor | None, *, real: bool
) -> tuple[Tensor | None, ...]:
    """The gradients, as torch has them, to φ, V, H, g and the screens. real: whether φ is."""
    rest = (None if bar is None else bar.conj() for bar in (V_bar, H_bar, g_bar))
    return phi_bar.real if real else phi_bar.conj(), *rest, None
