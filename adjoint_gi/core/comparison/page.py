"""A comparison as one HTML page that opens without a network and as JSON: the same tables, the pictures embedded."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from ..base.color import decode_srgb
from ..base.text import plain
from ..flux.agreement import LOUD, Agreement
from ..images.png import encode_png
from .budget import STATES, Budget, Entry
from .run import Result

GENERATOR = "Adjoint GI comparison"  # in the head of every page, and how we know our own
FORMAT = 1
STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1b1b; background: #fff; max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p { margin: .4rem 0; } .quiet { color: #5b5b5b; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .55rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th { font-weight: 600; border-bottom: 2px solid #999; } th:first-child, td:first-child { text-align: left; }
td.words { white-space: normal; text-align: left; min-width: 8rem; }
tr.best td { background: #e9f5ec; font-weight: 600; }
.loud { background: #fbe6e6; border-left: 5px solid #b00914; padding: .5rem .8rem; font-weight: 600; }
.good { background: #e9f5ec; border-left: 5px solid #2f7d46; padding: .5rem .8rem; }
.known { background: #f4f1e4; border-left: 5px solid #b39a3c; padding: .5rem .8rem; }
figure { margin: 0 0 1.6rem; } figcaption { color: #5b5b5b; font-size: 13px; }
img { max-width: 100%; height: auto; border: 1px solid #ddd; }
ul { padding-left: 1.2rem; margin: .4rem 0; }
"""
CAPTIONS = {
    "side by side": "All results and the reference at one exposure; grey where nothing was computed.",
    "differences": "How far the colours are off in the mean: blue is too dark in all, red too bright, grey not compared.",
    "error over time": "Relative root mean square error against the seconds that each method has computed.",
    "histogram": "How often each error occurs, on a square-root scale; the outermost bins hold what lies beyond.",
}


def percent(value: float | None) -> str:
    """A share with three digits, a dash for None or no number."""
    return "-" if value is None or not math.isfinite(value) else f"{plain(100 * value, 3)} %"


def number(value: float | None) -> str:
    """Four digits, a dash for None or no number."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.4g}"


def gap_of(result: Result, entry: Entry) -> float | None:
    """The duality gap (<L, g> - <W, Le>) / <W, Le> of one method over all receivers; None where it is not known, or where the method counts
    other path lengths."""
    shot = result.shot
    known = shot is not None and shot[0] and entry.complete and entry.lengths == result.lengths
    return None if not known else result.gathered(entry) / shot[0] - 1


def best_text(result: Result) -> str:
    """Which method is best, in one sentence."""
    best = result.winner
    if result.partial:
        return "There is no winner, as not all methods have run to their ends."
    if best is None:
        return "No method reached the error." if result.budget.kind == "error" else "There is no winner without a reference."
    if result.budget.kind == "error":
        return f"{best.label} was first to reach the error, after {best.seconds:.3g} s."
    word = "time" if result.budget.kind == "time" else "rays"
    return f"{best.label} has the least error at equal {word}: {percent(best.error)}."


def page(
    title: str, result: Result, pictures: Mapping[str, np.ndarray], notices: Iterable[Any], facts: Sequence[tuple[str, str]] = ()
) -> str:
    """The whole page. `pictures` (h, w, 3) sRGB-encoded; `notices` were found before; `facts` are names and values for the head."""
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta name="generator" content="{GENERATOR}"><meta name="viewport" content="width=device-width">',
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(_first(result))} {escape(best_text(result))}</p>",
    ]
    if result.partial:
        parts.append('<p class="loud">The comparison was stopped before its end.</p>')
    if facts:
        parts.append('<p class="quiet">' + " &middot; ".join(f"{escape(k)}: {escape(v)}" for k, v in facts) + "</p>")
    loud = [line for line in result.agreement.lines if line.startswith(LOUD)] if result.agreement is not None else []
    parts += [f'<p class="loud">{escape(line)}</p>' for line in loud]
    parts += ["<h2>Results</h2>", _results(result)]
    if result.refused:
        parts += ["<h2>Not compared</h2>", _list(str(n) for n in result.refused)]
    found = list(notices)
    notes = [str(n) for e in result.entries for n in e.notices] + [str(n) for n in found]
    if result.reference is not None:
        notes += [f"Reference: {n}" for n in result.reference.notices if n not in found]
    if notes:
        parts += ["<h2>Notes</h2>", _list(dict.fromkeys(notes))]
    if result.agreement is not None:
        parts += ["<h2>Agreement</h2>", _agreement(result.agreement)]
    for name, picture in pictures.items():
        parts += [f"<h2>{escape(name.capitalize())}</h2>", _figure(name, picture)]
    parts += [f"<h2>Settings</h2><details><summary>Of all methods</summary>{_settings(result)}</details>", "</body></html>"]
    return "\n".join(parts) + "\n"


def _first(result: Result) -> str:
    methods = "1 method" if len(result.entries) == 1 else f"{len(result.entries)} methods"
    text = f"{methods}, {result.budget.text}."
    r = result.reference
    if r is None:
        return text + " No reference."
    noise = "" if r.noise is None else (" (exact)" if r.noise == 0 else f" (its own noise: {percent(r.noise)})")
    return f"{text} Reference: {r.label}{noise}, known for {percent(float(r.valid.mean()))} of the receivers."


def _results(result: Result) -> str:
    unit = "W" if result.measure == "irradiance" else "W m-2 sr-1"
    gathered = f"&lt;L, g&gt;, {unit}"
    head = ["Method", "Error", "Mean off by", "Seconds", "Rays", gathered, "&lt;W, Le&gt;, W", "Duality gap", "Energy gap", "Run"]
    rows = []
    for e in sorted(result.entries, key=lambda e: math.inf if e.error is None else e.error):
        gap = gap_of(result, e)
        balance = e.solution.balance
        cells = [
            escape(e.label),
            percent(e.error),
            "-" if e.bias is None else f"{100 * e.bias:+.2f} %",
            f"{e.seconds:.2f}",
            f"{e.rays:,}",
            number(result.gathered(e)),
            "-" if result.shot is None else f"{result.shot[0]:.4g} &plusmn; {result.shot[1]:.1g}",
            "-" if gap is None else f"{100 * gap:+.2f} %",
            "-" if balance is None else percent(balance.gap),
            '<td class="words">' + STATES[e.state] + ("" if e.complete else ", partial") + "</td>",
        ]
        rows.append((cells, e is result.winner))
    return _table(head, rows)


def _agreement(found: Agreement) -> str:
    styles = {"Agree": "good", "Differs": "known", "Not compared": "known"}
    others = [line for line in found.lines if not line.startswith(LOUD)]  # these stand at the top of the page
    lines = [f'<p class="{styles[next(s for s in styles if line.startswith(s))]}">{escape(line)}</p>' for line in others]
    methods = found.methods
    shot = found.shot
    head = ["Object", f"Eq. 4, {found.groups.unit}" if shot is not None else "", *(escape(m.label) for m in methods)]
    rows = []
    for i, name in enumerate(found.groups.names):
        cells = [escape(name), f"{shot.value[i]:.4g} &plusmn; {shot.error[i]:.1g}" if shot is not None else ""]
        for k, m in enumerate(methods):
            noise = f" &plusmn; {m.error[i]:.1g}" if m.freedom else ""
            known = found.gaps is not None and math.isfinite(found.gaps[k, i])
            gap = f"<br><span class=quiet>{plain(100 * found.gaps[k, i], 3, sign='+')} %</span>" if known else ""
            cells.append(f"{m.value[i]:.4g}{noise}{gap}")
        rows.append((cells, False))
    pairs = [
        (
            [escape(d.first), escape(d.second), escape(d.object), f"{plain(100 * d.relative, 3, sign='+')} %", f"{d.t:.3g}", f"{d.p:.2g}"],
            False,
        )
        for d in found.differences
    ]
    pair_head = ["First", "Second", "Object", "Difference", "t beyond the allowances", "p after Sidak"]
    unit = f"{found.groups.unit}, colours summed"
    about = f"Flux of each object in {unit}, by Eq. 3. Eq. 4 needs receivers on surfaces."
    if shot is not None:
        about = (
            f"Flux of each object in {unit}: by Eq. 4 from particles of all lights, and by Eq. 3 from each method with its standard error. "
        )
        about += "Below stands the gap between the two equations. Both weigh light as the points of the receivers do."
    parts = [*lines, f"<p class=quiet>{escape(about)}</p>", _table(head, rows)]
    if pairs:
        summary = f"All {len(pairs)} pairs, each at the object where it differs most significantly"
        parts.append(f"<details><summary>{summary}</summary>{_table(pair_head, pairs)}</details>")
    return "\n".join(parts)


def _settings(result: Result) -> str:
    rows = []
    for e in result.entries:
        text = ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in e.settings.items())
        rows.append(([escape(e.label), f'<td class="words">{escape(text)}</td>'], False))
    return _table(["Method", "Settings"], rows)


def _table(head: Sequence[str], rows: Iterable[tuple[Sequence[str], bool]]) -> str:
    out = ["<div class=wide><table><tr>" + "".join(f"<th>{h}</th>" for h in head) + "</tr>"]
    for cells, best in rows:
        text = "".join(c if c.startswith("<td") else f"<td>{c}</td>" for c in cells)
        out.append(f'<tr class="best">{text}</tr>' if best else f"<tr>{text}</tr>")
    return "\n".join([*out, "</table></div>"])


def _list(items: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(i)}</li>" for i in items) + "</ul>"


def _figure(name: str, picture: np.ndarray) -> str:
    data = base64.b64encode(encode_png(decoded(picture))).decode("ascii")
    caption = CAPTIONS.get(name, "")
    height, width = picture.shape[:2]
    alt = escape(f"{name}: {caption}")
    return (
        f'<figure><img width="{width}" height="{height}" alt="{alt}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def decoded(picture: np.ndarray) -> np.ndarray:
    """Scene-linear values of sRGB-encoded ones, for writers that encode."""
    return decode_srgb(np.asarray(picture, np.float32))


def as_json(result: Result, notices: Iterable[Any] = ()) -> dict[str, Any]:
    """Everything on the page but the pictures, ready for JSON."""
    r, a, best = result.reference, result.agreement, result.winner
    return {
        "format": FORMAT,
        "generator": GENERATOR,
        "partial": result.partial,
        "seconds": result.seconds,
        "rays": result.rays,
        "budget": _budget(result.budget),
        "plan": result.settings,
        "reference": None
        if r is None
        else {
            "label": r.label,
            "noise": r.noise,
            "seconds": r.seconds,
            "known": float(r.valid.mean()),
            "mean": r.mean,
            "notices": [_notice(n) for n in r.notices],
        },
        "winner": best.method if best is not None else None,
        "methods": [_entry(result, e) for e in result.entries],
        "refused": [_notice(n) for n in result.refused],
        "notices": [_notice(n) for n in notices],
        "agreement": None if a is None else _agreement_json(a),
    }


def _budget(budget: Budget) -> dict[str, Any]:
    return {"kind": budget.kind, "value": budget.value, "limit": budget.limit}


def _entry(result: Result, e: Entry) -> dict[str, Any]:
    balance, shot, gap = e.solution.balance, result.shot, gap_of(result, e)
    return {
        "method": e.method,
        "label": e.label,
        "state": e.state,
        "complete": e.complete,
        "lengths": list(e.lengths),
        "error": e.error,
        "bias": e.bias,
        "seconds": e.seconds,
        "rays": e.rays,
        "flux_gathered": result.gathered(e),
        "flux_shot": shot[0] if shot is not None else None,
        "duality_gap": gap,
        "emitted_flux": e.solution.emitted_flux,
        "entering_flux": e.solution.entering_flux,
        "energy_balance": None
        if balance is None
        else {
            "emitted": balance.emitted,
            "absorbed": balance.absorbed,
            "escaped": balance.escaped,
            "unshot": balance.unshot,
            "gap": balance.gap,
        },
        "curve": [{"seconds": p.seconds, "rays": p.rays, "error": p.error} for p in e.curve],
        "settings": e.settings,
        "notices": [_notice(n) for n in e.notices],
    }


def _agreement_json(a: Agreement) -> dict[str, Any]:
    return {
        "agrees": a.agrees,
        "lines": list(a.lines),
        "unit": a.groups.unit,
        "objects": list(a.groups.names),
        "shot": None if a.shot is None else {"value": a.shot.value.tolist(), "error": a.shot.error.tolist()},
        "methods": [
            {
                "method": m.method,
                "value": m.value.tolist(),
                "error": m.error.tolist(),
                "freedom": m.freedom,
                "allowance": m.allowance,
                "lengths": list(m.lengths),
                "gap": a.gaps[k].tolist() if a.gaps is not None and np.isfinite(a.gaps[k]).all() else None,
            }
            for k, m in enumerate(a.methods)
        ],
        "differences": [vars(d) | {"significant": d.significant} for d in a.differences],
    }


def _notice(n: Any) -> dict[str, str]:
    return {"object": n.object, "reason": n.reason, "remedy": n.remedy, "severity": n.severity}
