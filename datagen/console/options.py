"""Options that many verbs have, each worded once."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

RunPlace = Annotated[str, Parameter(help="The run's folder or s3:// address; also of merged runs.")]
AsJson = Annotated[bool, Parameter(negative=(), help="Print one JSON document.")]
