"""The lamps of a scene, each in the class of its kind: point, spot, area, sun. Lamps do not block light."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..scene.arrays import Light
from ..scene.world import World
from .area import AreaLights
from .base import LampKind, LightKind, ParticleSource, Sample, Seen
from .places import Outlook
from .point import PointLights
from .spot import SpotLights
from .sun import SunLights

LAMP_KINDS: dict[str, type[LampKind]] = {"point": PointLights, "spot": SpotLights, "area": AreaLights, "sun": SunLights}


class Lamps:
    """Lamps by their number in the scene; each call goes to the kinds that are asked for.

    sized, shadow, large, importance (k,): as each kind has them. Raises ValueError for an unknown kind.
    """

    def __init__(self, world: World) -> None:
        self.world, lights = world, world.scene.lights
        self.count = len(lights)
        members: dict[tuple[str, str], list[int]] = {}
        for index, light in enumerate(lights):
            if light.kind not in LAMP_KINDS:
                raise ValueError(f"{light.name}: unknown kind of light {light.kind!r}")
            members.setdefault((light.kind, LAMP_KINDS[light.kind].form_of(light)), []).append(index)
        self.kinds: list[LampKind] = [LAMP_KINDS[kind]([lights[i] for i in rows], world) for (kind, _), rows in members.items()]

        # Where each lamp is: its kind, and its index there.
        self._kind, self._row = np.zeros(self.count, np.int8), np.zeros(self.count, np.int64)
        self.sized, self.shadow, self.large = (np.zeros(self.count, bool) for _ in range(3))
        self.importance = np.zeros(self.count)
        for number, (kind, rows) in enumerate(zip(self.kinds, members.values(), strict=True)):
            self._kind[rows], self._row[rows] = number, np.arange(len(rows))
            self.sized[rows], self.shadow[rows] = kind.sized, kind.shadow
            self.large[rows], self.importance[rows] = kind.sized and kind.large(), kind.importance

    def sample(self, i: np.ndarray, p: np.ndarray, u: np.ndarray, v: np.ndarray) -> Sample:
        """`LightKind.sample` of lamps `i` (n,)."""
        row = self._row[i]
        if len(self.kinds) == 1:
            return self.kinds[0].sample(row, p, u, v)
        kind = self._kind[i]
        present = np.unique(kind)
        if len(present) == 1:
            return self.kinds[present[0]].sample(row, p, u, v)
        n = len(i)
        out = Sample(*(np.empty(shape, np.float32) for shape in ((3, n), n, (3, n), n)))
        for k in present:
            which = np.flatnonzero(kind == k)
            part = self.kinds[k].sample(row[which], p[:, which], u[which], v[which])
            for whole, values in zip(out, part, strict=True):
                whole[..., which] = values
        return out

    def seen(self, o: np.ndarray, w: np.ndarray, distance: np.ndarray, lamps: np.ndarray) -> Iterator[tuple[int, Seen]]:
        """Each of `lamps`, and what rays from `o` along unit `w` (3, n) see of it before `distance` (n,), inf where they escape.

        Costs rays x lamps. Lamps without a size are not seen, nor yielded.
        """
        for i in lamps[self.sized[lamps]].tolist():
            found = self.kinds[self._kind[i]].seen(int(self._row[i]), o, w, distance)
            if len(found.rows):
                yield i, found

    def outlook(self) -> Outlook:
        """Where the lamps are and how they shine, in the order of the scene."""
        lights = self.world.scene.lights
        position = np.array([x.position for x in lights], np.float64).reshape(-1, 3) - self.world.center
        extent = [max(x.size_x, x.size_y) / 2 if x.kind == "area" else x.radius for x in lights]
        area = np.array([x.size_x * x.size_y if x.kind == "area" else 1.0 for x in lights])
        intensity = np.array([max(sum(x.color), 0.0) for x in lights]) * area
        axis = -np.array([x.axis_z for x in lights], np.float64).reshape(-1, 3)
        # An elliptic cone is taken for the round one around it.
        edge = [_edge(x) if x.kind == "spot" else 0.0 if x.kind == "area" else -1.0 for x in lights]
        lambert, far = (np.array([x.kind == kind for x in lights], bool) for kind in ("area", "sun"))
        return Outlook(position, np.array(extent, float), intensity, axis, np.array(edge, float), lambert, far)

    def source(self, i: int) -> ParticleSource:
        """Lamp `i`, for shooting."""
        kind: LightKind = self.kinds[self._kind[i]]
        return ParticleSource(kind, int(self._row[i]))

    def sources(self) -> list[ParticleSource]:
        """Those with some power, for shooting, in the order of the scene."""
        return [s for s in map(self.source, range(self.count)) if s.power > 0]


def _edge(light: Light) -> float:
    """Cosine of the widest angle to the axis at which a spot shines."""
    return math.cos(math.atan(math.tan(min(light.spot_angle, 3.14) / 2) * max(*light.spot_scale, 1e-6)))
