# The names that detector.py imports. The package itself loads a thousand files: half a minute and 1.5 GB.
from typing import Any

AutoModelForZeroShotObjectDetection: Any
AutoProcessor: Any
