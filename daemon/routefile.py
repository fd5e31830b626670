"""A ROUTE reply as GeoJSON, GPX or CSV, and in words."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

from rich.text import Text

Route = Mapping[str, Any]

_GPX = "http://www.topografix.com/GPX/1/1"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_DIGITS = 8  # of a degree: a millimetre


def geojson(route: Route) -> str:
    """Write RFC 7946: a point for the pole, a line string for each leg."""
    features = []
    if (pole := route["pole"]) is not None:
        place = [round(pole["lon_deg"], _DIGITS), round(pole["lat_deg"], _DIGITS)]
        about = {"name": "pole", "kind": "pole"} | {key: pole.get(key) for key in ("known", "sigma_m")}
        features.append(_feature("Point", place, about))
    for leg, places in _placed(route):
        line = [[round(lon, _DIGITS), round(lat, _DIGITS)] for lat, lon in places]
        about = {"name": _name(leg)} | {key: value for key, value in leg.items() if key != "points"}
        features.append(_feature("LineString", line, about))
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def gpx(route: Route) -> str:
    """Write GPX 1.1: a way point for the pole, a route for each leg."""
    ElementTree.register_namespace("", _GPX)
    root = ElementTree.Element(f"{{{_GPX}}}gpx", {"version": "1.1", "creator": "polecal"})
    root.set(f"{{{_XSI}}}schemaLocation", f"{_GPX} {_GPX}/gpx.xsd")
    if (pole := route["pole"]) is not None:
        _at(root, "wpt", pole["lat_deg"], pole["lon_deg"], name="pole")
    for leg, places in _placed(route):
        one = ElementTree.SubElement(root, f"{{{_GPX}}}rte")
        speed = f"{leg['direction']}, {leg['speed_mps']:g} m/s"
        for tag, text in (
            ("name", _name(leg)),
            ("desc", speed),
            ("number", leg["leg"]),
            ("type", leg["kind"]),
        ):
            ElementTree.SubElement(one, f"{{{_GPX}}}{tag}").text = str(text)
        for lat, lon in places:
            _at(one, "rtept", lat, lon)
    ElementTree.indent(root)
    out = io.BytesIO()
    ElementTree.ElementTree(root).write(out, encoding="UTF-8", xml_declaration=True)
    return out.getvalue().decode() + "\n"


def _at(parent: ElementTree.Element, tag: str, lat: float, lon: float, name: str = "") -> None:
    where = {"lat": f"{lat:.{_DIGITS}f}", "lon": f"{lon:.{_DIGITS}f}"}
    point = ElementTree.SubElement(parent, f"{{{_GPX}}}{tag}", where)
    if name:
        ElementTree.SubElement(point, f"{{{_GPX}}}name").text = name


def local_csv(route: Route) -> str:
    """Write a line a point: metres north and east of the pole."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(["north_m", "east_m", "heading_deg", "speed_mps", "direction", "leg", "kind"])
    for leg in route["legs"]:
        for point in leg["points"]:
            table.writerow([*point, *(leg[key] for key in ("speed_mps", "direction", "leg", "kind"))])
    return out.getvalue()


FORMATS: dict[str, Callable[[Route], str]] = {"geojson": geojson, "gpx": gpx, "csv": local_csv}


def _placed(route: Route) -> Iterator[tuple[dict[str, Any], list[tuple[float, float]]]]:
    """Give each leg with its points as latitudes and longitudes."""
    import pymap3d  # noqa: PLC0415

    for leg in route["legs"]:
        pole = route["pole"]
        at = pole["lat_deg"], pole["lon_deg"], pole["height_m"]
        places = [pymap3d.ned2geodetic(north, east, 0.0, *at)[:2] for north, east, _ in leg["points"]]
        yield leg, [(float(lat), float(lon)) for lat, lon in places]


def _name(leg: Mapping[str, Any]) -> str:
    if leg["kind"] == "turn":
        return f"{leg['leg']}: " + ("back off" if leg["direction"] == "reverse" else "to the next")
    return f"{leg['leg']}: past the pole heading {leg['heading_deg']:.0f}°, {leg['direction']}"


def words(route: Route) -> Iterator[Text]:
    """Say in a line each what it is for, and which approaches it has."""
    yield Text(f"session {route['session']}, {route['state']}" if route["session"] else route["state"])
    for why in route["why"]:
        yield Text(f"  {why}")
    for one in route["unseen"]:
        yield Text(f"  no approach shows the pole to {one['laser']} in slice {one['slice']}", style="yellow")
    passes = [leg for leg in route["legs"] if leg["kind"] == "pass"]
    if not passes:
        return
    pole = route["pole"]
    yield Text(
        f"pole at {pole['lat_deg']:.7f}, {pole['lon_deg']:.7f} ({pole['known']}, ±{pole['sigma_m']:.2f} m); "
        f"keep {route['clearance_m']:.1f} m off it"
    )
    yield Text(f"{len(passes)} approaches, {route['length_m']:.0f} m with the turns:", style="bold")
    yield Text(f"{'leg':>4} {'heading':>7} {'pole':>12} {'m/s':>4}", style="bold")
    for leg in passes:
        side_m = _right_m(leg)
        side = f"{abs(side_m):.1f} m {'right' if side_m > 0 else 'left'}"
        yield Text(
            f"{leg['leg']:>4} {leg['heading_deg']:>6.0f}° {side:>12} {leg['speed_mps']:>4.1f} "
            f"{leg['direction']}"
        )
    if route["left_out"]:
        yield Text(f"{route['left_out']} more are left out: ask again once these are driven", style="dim")


def _right_m(leg: Mapping[str, Any]) -> float:
    """Give how far to the right of its line a pass leaves the pole."""
    from math import cos, radians, sin  # noqa: PLC0415

    north, east, heading_deg = leg["points"][0]
    heading = radians(heading_deg)
    return float(north * sin(heading) - east * cos(heading))
