"""The layers of linkax, from the lowest to the highest, as CONTRIBUTING says: rooms of a layer as layer.room."""

LAYERS = ["files", "optional", "xla", "tables", "spatial", "model", "linalg", "equations"]
LAYERS += ["formulations"]
LAYERS += [f"simulation.{room}" for room in ("start", "integrate", "explain", "read", "simulate")]
LAYERS += ["analysis"]
LAYERS += [f"studies.{room}" for room in ("parameters", "laboratory", "fits", "sweeps", "tolerances", "synthesis")]
LAYERS += ["machines", "scenes", "scenery", "view", "plot", "cli"]


def layer(*names: str) -> int:
    """The index of the layer of a package, module or folder, by its names below `linkax`.

    **Raises:** `StopIteration` for one in no layer.
    """
    return next(i for i in range(len(LAYERS)) if LAYERS[i] in (names[0], ".".join(names[:2])))
