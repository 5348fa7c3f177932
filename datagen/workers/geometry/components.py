"""Connected components of meshes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


def vertex_components(faces: npt.NDArray[np.integer[Any]], n_vertices: int) -> npt.NDArray[np.int32]:
    """Component index (n_vertices,) of each vertex; faces (F, 3) join their vertices."""
    first, second = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    joined = coo_matrix((np.ones(len(first), np.bool_), (first, second)), (n_vertices, n_vertices))
    return connected_components(joined, directed=False)[1]
