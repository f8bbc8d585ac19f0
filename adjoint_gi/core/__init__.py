"""The computation, without Blender: scenes, methods, receivers, results."""

from .bsdf.lobes import LOBES
from .scene import substitutes

substitutes.register({kind.name: kind.as_diffuse for kind in LOBES})
