"""The sheet's potential energy as a sum of element terms, with gradient and Hessian assembled over the particles.

    U(x; b) = sum of terms + 1/2 sum_i b_i |x_i - a_i|^2

A `Term` is a batch of elements of one kind, each over a few particles. It needs only an energy: gradient and Hessian
follow by differentiation, and the tests compare a term that writes them out with that. The boundary springs b are the
unknown of the whole project, so they are an argument and not a term. The model is quasi-static: no mass, no velocity.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .block_tridiagonal import BlockTridiagonal, Layout, add_to_diagonal, assemble


class Term(eqx.Module):
    """A batch of energy elements of one kind."""

    vertices: eqx.AbstractVar[Int[np.ndarray, "m p"] | Int[Array, "m p"]]
    """Indices of each element's particles."""

    @abstractmethod
    def energy(self, x: Float[Array, "m p 3"]) -> Float[Array, " m"]:
        """Return the energy of each element [J] at its particles' positions [m]."""

    def gradient(self, x: Float[Array, "m p 3"]) -> Float[Array, "m p 3"]:
        """Return the derivative of each element's energy [N]."""
        return jax.grad(lambda y: jnp.sum(self.energy(y)))(x)

    def hessian(self, x: Float[Array, "m p 3"]) -> Float[Array, "m p 3 p 3"]:
        """Return the second derivative of each element's energy [N/m]."""
        _, p, _ = x.shape
        directions = jnp.eye(3 * p, dtype=x.dtype).reshape(3 * p, 1, p, 3)
        column = lambda d: jax.jvp(self.gradient, (x,), (jnp.broadcast_to(d, x.shape),))[1]  # noqa: E731
        return jnp.moveaxis(jax.vmap(column)(directions).reshape(p, 3, *x.shape), (0, 1), (3, 4))

    def positive_hessian(self, x: Float[Array, "m p 3"]) -> Float[Array, "m p 3 p 3"]:
        """Return a positive semi-definite stand-in for the Hessian [N/m], with negative eigenvalues set to zero.

        Newton steps use it where the Hessian leads uphill.
        """
        m, p, _ = x.shape
        values, vectors = jnp.linalg.eigh(self.hessian(x).reshape(m, 3 * p, 3 * p))
        clamped = (vectors * jnp.maximum(values, 0)[:, None, :]) @ vectors.swapaxes(1, 2)
        return clamped.reshape(m, p, 3, p, 3)


class SheetEnergy(eqx.Module):
    """Energy of one sheet: its terms, its rest positions, and the places of the terms' Hessians."""

    rest: Float[Array, "n 3"]
    """Anchors a of the boundary springs [m]."""
    terms: tuple[Term, ...]
    """Elements of every kind."""
    layout: Layout
    """Order of the particles in the Hessian."""
    places: tuple[Int[Array, "_m _p _p"], ...]
    """`Layout.pair_index` of each term."""

    @classmethod
    def build(cls, rest: Float[np.ndarray, "n 3"], terms: tuple[Term, ...], layout: Layout) -> "SheetEnergy":
        """Build the energy, with the places of every term's Hessian in the given layout.

        Raises:
            ValueError: a term couples particles outside the layout's band.
        """
        places = tuple(jnp.asarray(layout.pair_index(np.asarray(term.vertices))) for term in terms)
        return cls(rest=jnp.asarray(rest), terms=terms, layout=layout, places=places)

    def value(self, x: Float[Array, "n 3"], b: Float[Array, " n"]) -> Float[Array, ""]:
        """Return U(x; b) [J]."""
        boundary = 0.5 * jnp.sum(b[:, None] * (x - self.rest) ** 2)
        return boundary + sum(jnp.sum(term.energy(x[term.vertices])) for term in self.terms)

    def internal_gradient(self, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return the gradient of all terms, without the boundary springs [N]."""
        total = jnp.zeros_like(x)
        for term in self.terms:
            total = total.at[term.vertices].add(term.gradient(x[term.vertices]))
        return total

    def gradient(self, x: Float[Array, "n 3"], b: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """Return the gradient of U [N], which is minus the force on each particle."""
        return self.internal_gradient(x) + b[:, None] * (x - self.rest)

    def value_and_gradient(
        self, x: Float[Array, "n 3"], b: Float[Array, " n"]
    ) -> tuple[Float[Array, ""], Float[Array, "n 3"]]:
        """Return U [J] and its gradient [N]."""
        return self.value(x, b), self.gradient(x, b)

    def hessian(self, x: Float[Array, "n 3"], b: Float[Array, " n"], *, positive: bool = False) -> BlockTridiagonal:
        """Return the Hessian of U [N/m]; with `positive`, the sum of the terms' `positive_hessian`."""
        elements = [
            (place, (term.positive_hessian if positive else term.hessian)(x[term.vertices]))
            for term, place in zip(self.terms, self.places, strict=True)
        ]
        matrix = assemble(self.layout, elements)
        return add_to_diagonal(self.layout, matrix, b[:, None, None] * jnp.eye(3, dtype=x.dtype)[None])
