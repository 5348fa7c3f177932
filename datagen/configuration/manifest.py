"""The manifest of a new run: specification, layout, sources and versions.

It is separate from `specify`, which training also uses where no label can be made.
"""

from __future__ import annotations

import platform

from datagen import __version__
from datagen.cluster.preflight import versions_of
from datagen.configuration.arms import arm_versions
from datagen.schemas.fields import SCHEMAS
from datagen.schemas.record_files import utc_now
from datagen.schemas.run_records import Layout, Manifest
from datagen.schemas.specification import Specification
from datagen.workers.labels import load_label_source

_LIBRARIES = ("numpy", "scipy", "embreex", "sapien", "pybullet", "zarr", "obstore", "ray", "trimesh")


def manifest_of(
    spec: Specification, layout: Layout, sources: dict[str, str], schema_version: int | None = None
) -> Manifest:
    """The manifest of a new run; `schema_version` is that of the run whose scenes are labelled."""
    source = load_label_source(spec.label_source)
    newest = SCHEMAS[source.schema].version
    return Manifest(
        spec=spec,
        spec_hash=spec.hash(),
        schema_name=source.schema,
        schema_version=newest if schema_version is None else min(schema_version, newest),
        layout=layout,
        code_version=__version__,
        libraries={name: found for name, found in versions_of(_LIBRARIES).items() if found}
        | arm_versions(spec.label_source),
        platform=platform.platform(),
        created=utc_now(),
        sources=sources,
    )
