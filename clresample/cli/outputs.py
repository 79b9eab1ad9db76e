"""Checks the outputs of a command before it computes anything."""

from __future__ import annotations

from pathlib import Path

from .options import check_matplotlib


def folder_outputs(arguments, names):
    """Paths of all files that `names` has, in the folder -o; deblended.png is the last of them.

    Raises ValueError where one of them could not be written.
    """
    from ..files.atomic import check_folder, check_output

    if not arguments.output:
        raise ValueError("-o is empty: give a folder to write into, . for this one")
    folder = Path(arguments.output)
    check_folder(folder)
    paths = [folder / name for name in names]
    for path in paths if folder.is_dir() else ():
        check_output(path, overwrite=arguments.overwrite)
    if not arguments.no_figure:
        check_matplotlib(names[-1], "; or give --no-figure")
    return paths


def check_scene(arguments, scene, paths):
    """Raises ValueError if an output is an input or cannot store the channels' names."""
    from ..files.atomic import check_output
    from ..files.fits_names import check_catalogue_names

    for path in paths if paths[0].parent.is_dir() else ():
        check_output(path, overwrite=arguments.overwrite, inputs=scene.inputs.values())
    try:
        magnitudes = scene.observations[0].zero_points is not None
        check_catalogue_names(scene.observations, magnitudes=magnitudes)
    except ValueError as error:
        raise ValueError(f"{arguments.scene}: {error}") from error


def file_outputs(arguments, inputs):
    """The paths of OUT and, if requested, PNG.

    Raises ValueError where one of them could not be written, or is a file that is read.
    """
    from ..files.atomic import check_folder, check_output

    if not arguments.output:
        raise ValueError("-o is empty: give a file to write")
    paths = [Path(path) for path in (arguments.output, arguments.plot) if path]
    for path in paths:
        for _ in range(2):  # the second time with what a killed run had all but written
            check_output(path, overwrite=arguments.overwrite, inputs=inputs)
            check_folder(path.absolute().parent)
    if len({path.absolute() for path in paths}) < len(paths):
        raise ValueError(f"{arguments.plot}: is both the image and the picture to write")
    if arguments.plot:
        check_matplotlib("--plot")
    return paths
