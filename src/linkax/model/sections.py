"""Cross-sections of beams, from stiffnesses or from a profile and a material."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Number, Vector, namespace, number, positive, real, require, require_type
from linkax.xla.arrays import Array, Scalar
from linkax.xla.tracing import concrete

GIVE_MATERIAL = "give a lx.Material(youngs_modulus, poissons_ratio, density)"


class Material(eqx.Module):
    """An isotropic elastic material.

    **Arguments:** `youngs_modulus`: E [Pa]; `poissons_ratio`: ν; `density`: ρ [kg/m³].

    **Raises:** `ValueError` for a modulus or a density that is not positive, and for ν outside (−1, 0.5].
    """

    youngs_modulus: Scalar
    poissons_ratio: Scalar
    density: Scalar

    def __init__(self, youngs_modulus: Number, poissons_ratio: Number, density: Number) -> None:
        self.youngs_modulus = positive(youngs_modulus, "material: youngs_modulus [Pa]")
        what = "material: poissons_ratio"
        ratio = number(poissons_ratio, (), what)
        self.poissons_ratio = require(ratio, lambda x: (x > -1.0) & (x <= 0.5), what, "it must be in (-1, 0.5]")
        self.density = positive(density, "material: density [kg/m³]")

    @property
    def shear_modulus(self) -> Scalar:
        """G = E / 2(1 + ν) [Pa]."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio))


class Section(eqx.Module):
    """The cross-section of a beam along x, in principal axes y and z through its centroid.

    **Arguments:**

    - `bending_stiffness`: E I_y and E I_z [N m²], for bending about y (deflection along z) and about z (deflection
      along y), or one number for both.
    - `linear_density`: ρ A [kg/m].
    - `axial_stiffness`: E A [N], which beams need that stretch.
    - `torsional_stiffness`: G J [N m²], which beams need that twist.
    - `shear_stiffness`: k G A along y and z [N], with the shear coefficient k, or one number for both, which beams
      need that shear.
    - `rotary_inertia`: ρ I_y and ρ I_z [kg m], or one number for both. Default: ρ A × E I / E A, as for a uniform
      material, and zero without `axial_stiffness`.

    **Raises:** `ValueError` for a stiffness or a density that is not positive, and for a negative inertia.
    """

    bending_stiffness: Float[Array, "2"]
    linear_density: Scalar
    axial_stiffness: Scalar | None
    torsional_stiffness: Scalar | None
    shear_stiffness: Float[Array, "2"] | None
    rotary_inertia: Float[Array, "2"]

    def __init__(
        self,
        bending_stiffness: Number | Vector,
        linear_density: Number,
        axial_stiffness: Number | None = None,
        torsional_stiffness: Number | None = None,
        shear_stiffness: Number | Vector | None = None,
        rotary_inertia: Number | Vector | None = None,
    ) -> None:
        self.bending_stiffness = _both(bending_stiffness, "section: bending_stiffness [N m²]")
        self.linear_density = positive(linear_density, "section: linear_density [kg/m]")
        given = lambda entry, check, what: None if entry is None else check(entry, f"section: {what}")
        self.axial_stiffness = given(axial_stiffness, positive, "axial_stiffness [N]")
        self.torsional_stiffness = given(torsional_stiffness, positive, "torsional_stiffness [N m²]")
        self.shear_stiffness = given(shear_stiffness, _both, "shear_stiffness [N]")
        if rotary_inertia is not None:
            what = "section: rotary_inertia [kg m]"
            pair = _pair(rotary_inertia, what)
            self.rotary_inertia = require(pair, lambda x: (x >= 0.0).all(), what, "it must be zero or more")
        elif self.axial_stiffness is not None:
            self.rotary_inertia = self.linear_density * self.bending_stiffness / self.axial_stiffness
        else:
            self.rotary_inertia = np.zeros(2)

    def stiffness(self, strain: int) -> Scalar | None:
        """Return the stiffness of strain 0 to 5, or None: twist, bending about y, z, stretch, shear along y, z."""
        of_strain = [
            self.torsional_stiffness,
            self.bending_stiffness[0],
            self.bending_stiffness[1],
            self.axial_stiffness,
            None if self.shear_stiffness is None else self.shear_stiffness[0],
            None if self.shear_stiffness is None else self.shear_stiffness[1],
        ]
        return of_strain[strain]


def _pair(entry: Any, what: str) -> Float[Array, "2"]:
    """Read two numbers, or one for both."""
    array = real(entry, what)
    return number(array * np.ones(2) if array.shape == () else array, (2,), what)


def _both(entry: Any, what: str) -> Float[Array, "2"]:
    return require(_pair(entry, what), lambda x: (x > 0.0).all(), what, "it must be positive")


def _of_profile(
    material: Material,
    area: Scalar,
    second_moments: tuple[Scalar, Scalar],
    torsion_constant: Scalar,
    shear_coefficients: tuple[Scalar, Scalar],
) -> Section:
    """Make a section of one material; `second_moments`: of area, about y and z [m⁴]."""
    young, shear, density = material.youngs_modulus, material.shear_modulus, material.density
    moments = jnp.stack(jnp.broadcast_arrays(*second_moments))
    return Section(
        bending_stiffness=young * moments,
        linear_density=density * area,
        axial_stiffness=young * area,
        torsional_stiffness=shear * torsion_constant,
        shear_stiffness=shear * area * jnp.stack(jnp.broadcast_arrays(*shear_coefficients)),
        rotary_inertia=density * moments,
    )


def _wall(thickness: Number, sizes: tuple[Scalar, ...], what: str) -> Scalar:
    """Check that walls of a thickness fit into a profile of these sizes."""
    most = namespace(*sizes).stack(sizes).min() / 2.0
    known_most = "" if concrete(most) is None else f", {float(most)}"
    remedy = f"it must be positive, and less than half of the profile{known_most}"
    return require(number(thickness, (), what), lambda metres: (metres > 0.0) & (metres < most), what, remedy)


def rectangle(width: Number, height: Number, material: Material, thickness: Number | None = None) -> Section:
    """Make the section of a rectangular profile, solid or hollow.

    Its torsion constant is that of Young and Budynas, Roark's Formulas for Stress and Strain (7th ed., table 10.1):
    Bredt's formula for thin walls, a series for solid profiles. Its shear coefficients are those of Cowper, Journal
    of Applied Mechanics 33 (1966), for thin-walled boxes and for solid rectangles.

    **Arguments:** `width` along y and `height` along z [m]; `material`; `thickness` of the walls [m] (default: solid).

    **Raises:** `ValueError` for a size that is not positive, and for walls that do not fit.
    """
    width, height = positive(width, "rectangle: width [m]"), positive(height, "rectangle: height [m]")
    require_type(material, Material, "rectangle: material", GIVE_MATERIAL)
    ratio = material.poissons_ratio
    if thickness is None:
        long, short = jnp.maximum(width, height), jnp.minimum(width, height)
        slimness = short / long
        torsion = long * short**3 / 16.0 * (16.0 / 3.0 - 3.36 * slimness * (1.0 - slimness**4 / 12.0))
        shear = 10.0 * (1.0 + ratio) / (12.0 + 11.0 * ratio)
        second_moments = width * height**3 / 12.0, height * width**3 / 12.0
        return _of_profile(material, width * height, second_moments, torsion, (shear, shear))
    thickness = _wall(thickness, (width, height), "rectangle: thickness [m]")
    inner_width, inner_height = width - 2.0 * thickness, height - 2.0 * thickness
    second_moments = (
        (width * height**3 - inner_width * inner_height**3) / 12.0,
        (height * width**3 - inner_height * inner_width**3) / 12.0,
    )
    across, along = width - thickness, height - thickness  # of the middle of the walls
    torsion = 2.0 * thickness * across**2 * along**2 / (across + along)
    area = width * height - inner_width * inner_height
    shears = _box_shear(across, along, ratio), _box_shear(along, across, ratio)
    return _of_profile(material, area, second_moments, torsion, (shears[1], shears[0]))


def _box_shear(width: Scalar, height: Scalar, ratio: Scalar) -> Scalar:
    """Compute Cowper's shear coefficient of a thin-walled box, for a force along its height."""
    n = width / height
    m = n  # × the thickness of the flanges over that of the webs
    flanges = 12.0 + 72.0 * m + 150.0 * m**2 + 90.0 * m**3 + ratio * (11.0 + 66.0 * m + 135.0 * m**2 + 90.0 * m**3)
    across = 10.0 * n**2 * ((3.0 + ratio) * m + 3.0 * m**2)
    return 10.0 * (1.0 + ratio) * (1.0 + 3.0 * m) ** 2 / (flanges + across)


def circle(diameter: Number, material: Material, thickness: Number | None = None) -> Section:
    """Make the section of a circular profile, solid or a tube.

    Its shear coefficient is that of Cowper, Journal of Applied Mechanics 33 (1966).

    **Arguments:** outer `diameter` [m]; `material`; `thickness` of the wall [m] (default: solid).

    **Raises:** `ValueError` for a size that is not positive, and for walls that do not fit.
    """
    diameter = positive(diameter, "circle: diameter [m]")
    require_type(material, Material, "circle: material", GIVE_MATERIAL)
    inner = 0.0 * diameter
    if thickness is not None:
        inner = diameter - 2.0 * _wall(thickness, (diameter,), "circle: thickness [m]")
    second_moment = math.pi / 64.0 * (diameter**4 - inner**4)
    ratio, hollow = material.poissons_ratio, (inner / diameter) ** 2
    squared = (1.0 + hollow) ** 2
    shear = 6.0 * (1.0 + ratio) * squared / ((7.0 + 6.0 * ratio) * squared + (20.0 + 12.0 * ratio) * hollow)
    area = math.pi / 4.0 * (diameter**2 - inner**2)
    return _of_profile(material, area, (second_moment, second_moment), 2.0 * second_moment, (shear, shear))
