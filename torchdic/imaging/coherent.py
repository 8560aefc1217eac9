"""The images of one focus by scalar light, with their derivative written out.

With S the spectrum behind the pupil, E the defocus, D the factor of a prism and w the source's weight, an image is

    I = Σ w·|U|²  over the sources,    U = F⁻¹[D·E·S].

Let Ī be the gradient to an image, and C = F*[2w·Ī·U], where F* is the adjoint of F⁻¹: a transform without a factor, of
which only the window's waves count. Then, by torch's rule for the gradient to a complex number,

    T = Σ D·C  over the prisms,    S̄ = E*·T,    Ē = S*·T,    D̄ = (E·S)*·C,    w̄ = Σ Ī·|U|²  over images and pixels.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.memory.batches import in_cache, once
from torchdic.plane_waves import to_field


def coherent_images(
    spectrum: Complex[Tensor, "source v u"],
    defocus: Complex[Tensor, "source v u"],
    transfers: Sequence[Float[Tensor, "_ v u"]],
    weights: Float[Tensor, " source"],
    shape: tuple[int, int],
) -> Float[Tensor, "prism row column"]:
    """The images of each prism, Σ over sources of w·|F⁻¹[D·E·S]|².

    spectrum: S, behind the pupil.
    defocus: E, to this focus.
    transfers: D of each prism.
    weights: w of each source.
    shape: of the images (y, x), along no axis smaller than the spectrum.
    """
    return _Coherent.apply(spectrum, defocus, weights, shape, *transfers)  # pyright: ignore[reportReturnType]


class _Coherent(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, S: Tensor, E: Tensor, weights: Tensor, shape: tuple[int, int], *transfers: Tensor) -> Tensor:
        ctx.save_for_backward(S, E, weights, *transfers)
        images = S.real.new_zeros(len(transfers), *shape)
        for part, fields in _fields(S, E, transfers, shape):
            for image, field in zip(images, fields, strict=True):
                squares = torch.tensordot(weights[part], torch.view_as_real(field).square_(), 1)
                image += squares[..., 0]
                image += squares[..., 1]
        return images

    @staticmethod
    @once
    def backward(ctx: Any, images_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        S, E, weights, *transfers = ctx.saved_tensors
        (v, u), shape = S.shape[1:], images_bar.shape[1:]
        twice = (2 * images_bar)[..., None].expand(*images_bar.shape, 2).contiguous()
        S_bar, E_bar, weights_bar, _, *transfers_bar = (
            torch.zeros_like(t) if isinstance(t, Tensor) and needed else None
            for t, needed in zip((S, E, weights, None, *transfers), ctx.needs_input_grad, strict=True)
        )
        for part, fields in _fields(S, E, transfers, shape):
            w, T = weights[part, None, None], torch.zeros_like(S[part])
            for D, D_bar, bar, field in zip(transfers, transfers_bar, twice, fields, strict=True):
                U = torch.view_as_real(field)
                if weights_bar is not None:
                    weights_bar[part] += (U.square() * bar).sum((1, 2, 3)) / 2
                U *= bar
                C = torch.fft.fft2(field)[:, :v, :u]
                T += _some(D, part).to(C.dtype) * C
                if D_bar is not None:
                    own = (E[part] * S[part]).conj() * (w * C)
                    _some(D_bar, part).add_(own.real.sum_to_size(_some(D, part).shape))
            T *= w
            if S_bar is not None:
                S_bar[part] = E[part].conj() * T
            if E_bar is not None:
                E_bar[part] = S[part].conj() * T
        return S_bar, E_bar, weights_bar, None, *transfers_bar


def _fields(
    S: Tensor, E: Tensor, transfers: Sequence[Tensor], shape: Sequence[int]
) -> Iterator[tuple[slice, Iterator[Tensor]]]:
    """Sources whose fields the caches hold, and U of each prism: one part of the sources after the other."""
    for part in in_cache(S[:, :1, :1].expand(-1, *shape)):
        wave = E[part] * S[part]
        padded = wave.new_zeros(len(wave), *shape)
        yield part, (_field(padded, wave, _some(D, part)) for D in transfers)


def _field(padded: Tensor, wave: Tensor, D: Tensor) -> Tensor:
    """U of one prism. padded: an array of U's shape, whose first waves are overwritten, and the others 0."""
    _, v, u = wave.shape
    torch.mul(D.to(wave.dtype), wave, out=padded[:, :v, :u])
    return to_field(padded)


def _some(D: Tensor, part: slice) -> Tensor:
    """A prism's factor for some of the sources."""
    return D if len(D) == 1 else D[part]
