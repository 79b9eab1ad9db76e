"""Links to other packages' documentation, without a network: inventories of what is named here.

Sphinx's intersphinx reads an inventory of each project from its web site when it builds; these are
written from the list below instead, so that a build needs no network and has no warning. Objects
that are not in it stay plain text.
"""

import zlib

# {project: (address, {object: page})}; a page's * is the object's full name
ASTROPY = "api/*.html#*"
NUMPY = "reference/generated/*.html#*"
PROJECTS = {
    "python": (
        "https://docs.python.org/3/",
        {
            "logging.basicConfig": "library/logging.html#*",
            "warnings.filterwarnings": "library/warnings.html#*",
        },
    ),
    "numpy": (
        "https://numpy.org/doc/stable/",
        {"numpy.ndarray": NUMPY, "numpy.random.Generator": "reference/random/generator.html#*"},
    ),
    "scipy": (
        "https://docs.scipy.org/doc/scipy/",
        {"scipy.sparse.linalg.LinearOperator": NUMPY},
    ),
    "astropy": (
        "https://docs.astropy.org/en/stable/",
        {
            "astropy.coordinates.SkyCoord": ASTROPY,
            "astropy.nddata.CCDData": ASTROPY,
            "astropy.nddata.Cutout2D": ASTROPY,
            "astropy.nddata.NDData": ASTROPY,
            "astropy.table.QTable": ASTROPY,
            "astropy.units.Quantity": ASTROPY,
            "astropy.wcs.WCS": ASTROPY,
        },
    ),
    "matplotlib": (
        "https://matplotlib.org/stable/",
        {"matplotlib.figure.Figure": "api/figure_api.html#*"},
    ),
}
# Short names that docstrings use, each with its object; a WCS is any package's, and no link.
SHORT = {
    name.rpartition(".")[2]: name
    for name in PROJECTS["astropy"][1] | PROJECTS["scipy"][1]
    if name != "astropy.wcs.WCS"
}


def inventory(project) -> bytes:
    """The inventory of a project in Sphinx's format, version 2."""
    _, objects = PROJECTS[project]
    kind = "function" if project == "python" else "class"
    lines = [f"{name} py:{kind} 1 {page.replace('*', name)} -\n" for name, page in objects.items()]
    head = f"# Sphinx inventory version 2\n# Project: {project}\n# Version: \n"
    head += "# The remainder of this file is compressed using zlib.\n"
    return head.encode() + zlib.compress("".join(lines).encode())


def write_inventories(folder):
    """Write all inventories into a folder; returns the `intersphinx_mapping` that reads them."""
    folder.mkdir(parents=True, exist_ok=True)
    mapping = {}
    for project, (address, _) in PROJECTS.items():
        path = folder / f"{project}.inv"
        path.write_bytes(inventory(project))
        mapping[project] = (address, str(path))
    return mapping
