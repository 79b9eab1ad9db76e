"""Free parameters of scarlet2's scenes, for the benches that fit by it."""

from __future__ import annotations

from functools import partial


def free_parameters(package, scene, *, spectrum, morphology):
    """Lets the spectra and morphologies of a scarlet2 Scene vary: positive, and in [0, 1].

    package: scarlet2; spectrum: step relative to the spectrum; morphology: step
    """
    import numpyro.distributions.constraints as constraints

    step = partial(package.relative_step, factor=spectrum)
    with package.Parameters(scene):
        for i, source in enumerate(scene.sources):
            package.Parameter(
                source.spectrum,
                name=f"spectrum:{i}",
                constraint=constraints.positive,
                stepsize=step,
            )
            package.Parameter(
                source.morphology,
                name=f"morphology:{i}",
                constraint=constraints.unit_interval,
                stepsize=morphology,
            )
