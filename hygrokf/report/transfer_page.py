"""`report.html` of a transfer: the verdict, what travels, what differs, what re-estimating gains."""

from __future__ import annotations

import io
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from hygrokf.data.files import REPORT, TRANSFER, TRANSFER_SERIES, TYPE, write_bytes_whole, write_text_whole
from hygrokf.data.lookup import number
from hygrokf.identification.results import ResultFault, dump, write_fit
from hygrokf.identification.turbine_type import TurbineType, write_type
from hygrokf.identification.verdict import told
from hygrokf.identification.wording import NONE, fixed, plain_number, sentence, text_of
from hygrokf.report.figures.transfer import (
    QUANTITIES,
    SETS,
    figure_course,
    figure_parameters,
    figure_sets,
    figure_type,
)
from hygrokf.report.fit_page import write_report
from hygrokf.report.fit_tables import Table
from hygrokf.report.html import document, figure_html, numbers_html, prose, section, tables_html
from hygrokf.transfer.procedure import Transfer, transfer_json
from hygrokf.transfer.verdict import NOT
from hygrokf.version import __version__


def write_transfer(
    transfers: Sequence[Transfer], directory: str | os.PathLike[str], pooled: TurbineType | None = None
) -> Path:
    """Write transfer.json, transfer.npz and report.html, each record's own fit in a folder of its name, and type.json.

    The fit in a record's folder is the one to use there: re-estimated where that was called for.  Returns the path of
    report.html.  Raises OSError as the system gives it.
    """
    folder = Path(directory)
    data, series = transfer_json(transfers, pooled), [one.series for one in transfers]
    text, page, buffer = dump(data), transfer_page(json.loads(dump(data)), series), io.BytesIO()
    np.savez_compressed(
        buffer,
        **{f"{i}/{name}": v for i, one in enumerate(series) for name, v in one.items()},  # type: ignore[arg-type]  # its flag is a keyword too
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / REPORT).unlink(missing_ok=True)
    for one, name in zip(transfers, folders([str(t.results["name"]) for t in transfers]), strict=True):
        if one.adapted is not None:
            write_fit(one.adapted, folder / name)
            write_report(folder / name)
    if pooled is not None:
        write_type(pooled, folder / TYPE)
    write_bytes_whole(folder / TRANSFER_SERIES, buffer.getvalue())
    write_text_whole(folder / TRANSFER, text)
    return write_text_whole(folder / REPORT, page)


def rewrite_transfer(directory: str | os.PathLike[str]) -> Path:
    """Write report.html again from transfer.json and transfer.npz.  Raises ResultFault where these cannot be read."""
    folder = Path(directory)
    try:
        data = json.loads((folder / TRANSFER).read_text(encoding="utf-8"))
        series: list[dict] = [{} for _ in data["records"]]
        with open(folder / TRANSFER_SERIES, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            for key in file.files:
                place, _, name = key.partition("/")
                series[int(place)][name] = np.asarray(file[key])
        page = transfer_page(data, series)
    except Exception as fault:  # whatever a damaged file leads to
        raise ResultFault(
            f"{folder}: expected {TRANSFER} and {TRANSFER_SERIES} as `hygrokf transfer` writes them, found "
            f"{type(fault).__name__} {fault}; run it again"
        ) from None
    return write_text_whole(folder / REPORT, page)


def folders(names: Sequence[str]) -> list[str]:
    """A folder's name for each record: its own in plain letters, numbered where two would be the same."""
    result: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "record"
        number_, made = 2, plain
        while made in result:
            made, number_ = f"{plain}-{number_}", number_ + 1
        result.append(made)
    return result


def transfer_page(found: Mapping, series: Sequence[Mapping[str, np.ndarray]]) -> str:
    """The whole page as HTML text: a pure function of transfer.json and transfer.npz."""
    records = found["records"]
    source = text_of(found["from"]["name"])
    names = [text_of(one["name"]) for one in records]
    parts = [_head(found, source, names), _cards(records)]
    for i, one in enumerate(records):
        parts.append(_record(one, series[i] if i < len(series) else {}, i, len(records) > 1))
    parts += [type_section(found.get("type")), _foot(found)]
    return document(f"{source} on {', '.join(names)} – hygrokf transfer", parts)


def _head(found: Mapping, source: str, names: Sequence[str]) -> str:
    banner = ""
    if any(one.get("synthetic") for one in found["records"]):
        banner = (
            "<p class='banner synthetic'><b>SYNTHETIC</b> At least one of these records was made by a computer: its "
            "numbers were not measured.</p>"
        )
    kind = "type of turbine" if found["from"]["kind"] == "type" else "fit"
    return (
        "<header><p class=kind>Hygrothermal model of an enclosure · transfer</p>"
        f"<h1>{escape(source)} on {escape(', '.join(names))}</h1>"
        f"<p class=meta>The {kind} of {escape(source)}, tried on other records.</p>{banner}"
        f"{numbers_html(found['from'].get('verdicts'), f'The numbers of {source}')}</header>"
    )


def _cards(records: Sequence[Mapping]) -> str:
    cards = []
    for one in records:
        reasons = "".join(f"<p>{prose(sentence(text_of(line)))}</p>" for line in one["reasons"])
        open_ = " open" if one["verdict"] == NOT else ""
        own = numbers_html(one.get("verdicts"), "The numbers of the model to use here")
        cards.append(
            f"<div class='card wide{open_}'><p class=label>{escape(text_of(one['name']))}</p>"
            f"<p class='value words'>{escape(sentence(text_of(one['sentence'])))}</p>{reasons}{own}</div>"
        )
    return f"<section class=cards>{''.join(cards)}</section>"


def _record(one: Mapping, series: Mapping[str, np.ndarray], place: int, several: bool) -> str:
    heading = f"{text_of(one['name'])}: what travels" if several else "What travels"
    said = "".join(f"<p class=note>{prose(sentence(text_of(line)))}</p>" for line in one["statements"])
    return section(
        heading,
        said,
        tables_html((groups_table(one), "No group of parameters could be judged.")),
        figure_html(
            f"parameters-{place}",
            "Parameters, own against the fit's",
            "95 % bounds count the uncertainty of both; shaded is what does not matter. Red groups differ.",
            lambda: figure_parameters(one),
        ),
        tables_html((errors_table(one), "Nothing was scored.")),
        figure_html(
            f"sets-{place}",
            "Held-out errors" if one["period"] == "validation" else "Errors of the identification period",
            "With 95 % bounds.",
            lambda: figure_sets(one),
        ),
        figure_html(
            f"course-{place}",
            "The first held-out days",
            "The free run should stay with the blue readings.",
            lambda: figure_course(series, bool(one["re_estimate"])),
        ),
        tables_html((parameters_table(one), "There are no parameters."), (ratios_table(one), "No likelihood ratio was needed.")),
    )  # fmt: skip


def groups_table(one: Mapping) -> Table | None:
    """Group by group: the statistic, p, what the difference does to the simulation, and what follows."""
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for row in one["groups"]:
        if "p" not in row:
            rows.append((text_of(row["group"]), NONE, NONE, NONE, NONE, NONE, text_of(row["statement"])))
            continue
        if row["outcome"] == "differs":
            marked.append(len(rows))
        effect = [fixed(number(row, "effect", q)) for q in QUANTITIES]
        rows.append(
            (
                text_of(row["group"]), fixed(row["statistic"], 1), str(row["df"]), _chance(row["p_adjusted"]), *effect,
                text_of(row["statement"]),
            )
        )  # fmt: skip
    if not rows:
        return None
    return Table(
        "Groups of parameters",
        ("", "χ²", "df", "p", "[K]", "[g/m³]", "what follows"),
        tuple(rows),
        left=(0, 6),
        marked=tuple(marked),
        groups=(("", 4), ("changes the simulation by", 2), ("", 1)),
        note=(
            "χ²: what letting this group differ explains, beside the groups that were let differ before it. p: corrected for "
            "the number of groups. Changes: root mean square over the record."
        ),
    )


def errors_table(one: Mapping) -> Table | None:
    """Errors of the four sets and the rules on the held-out instants that all of them score."""
    names = [n for n in SETS if any(n in one["rmse"].get(q, {}) for q in QUANTITIES)]
    rows = []
    for name in names:
        cells = [SETS[name]]
        for q in QUANTITIES:
            row = one["rmse"].get(q, {}).get(name)
            if row is None:
                cells += [NONE] * 4
                continue
            bounds = (
                NONE if row["bounds"] is None else f"{fixed(row['bounds'][0])} … {fixed(row['bounds'][1])}"
            )
            cells += [fixed(_number(row[r])) for r in ("operation", "standstill", "total")] + [bounds]
        rows.append(tuple(cells))
    if not rows:
        return None
    columns = ("op", "st", "tot", "tot, 95 %")
    n = "; ".join(
        f"{QUANTITIES[q][0]} n = {rows['as_is']['n']['total']}"
        for q, rows in one["rmse"].items()
        if "as_is" in rows
    )
    return Table(
        f"RMSE, {'held out' if one['period'] == 'validation' else 'identification period: nothing is held out'}",
        ("", *columns, *columns),
        tuple(rows),
        groups=(("", 1), ("temperature [K]", 4), ("absolute humidity [g/m³]", 4)),
        note=f"{n}: the instants that every set and rule scores, so a number may differ from that of a fit's own page, which scores "
        "each by itself. The rule of the temperature was fitted to this record's own identification period.",
    )


def parameters_table(one: Mapping) -> Table | None:
    """Every parameter of the cabinet: original, own, difference."""
    rows = []
    for name, row in one["parameters"].items():
        d, ratio = row["difference"], row["difference_is"] == "ratio"
        cells = [NONE, NONE]
        if d is not None:
            cells = [
                ("× " if ratio else "") + plain_number(d["value"]),
                f"{plain_number(d['lower'])} … {plain_number(d['upper'])}",
            ]
        both = [_with_se(row["original"], row["original_se"]), _with_se(row["own"], row["own_se"])]
        rows.append((f"{name} [{row['unit']}]", *both, *cells))
    if not rows:
        return None
    return Table(
        "Parameters",
        ("parameter", "original", "own", "difference", "95 %"),
        tuple(rows),
        note="± standard error. ×: ratio of own to original value. The values to go on with are in the record's own folder.",
    )


def ratios_table(one: Mapping) -> Table | None:
    """Exact likelihood ratios on this record."""
    rows = [
        (
            text_of(row["of"]), fixed(row["likelihood_ratio"], 1), str(row["df"]), fixed(row["factor"]), _chance(row["p"]),
        )
        for row in one["likelihood_ratios"]
    ]  # fmt: skip
    if not rows:
        return None
    return Table(
        "Likelihood ratios on this record alone",
        ("", "2 ln L", "df", "factor", "p"),
        tuple(rows),
        note=(
            "The original values are taken as exact here, so small p of the rest need not mean that it differs: the table of "
            "groups counts both uncertainties. Factor: by which coloured noise widens; 2 ln L is divided by it."
        ),
    )


_ALIKE = (
    "A spread of 0 says that these turbines differ by no more than their own uncertainty explains, not that the next one is "
    "like them: of few turbines the spread is hardly known, and the prediction is then too narrow."
)


def type_section(data: object, left_out: Sequence[str] = ()) -> str:
    """A pooled type as a section, from its plain data; nothing where there is none.  `left_out`: turbines that it is without."""
    if not isinstance(data, Mapping):
        return ""
    rows, none = [], False
    for name, row in data["type_parameters"].items():
        ends = row["in_unit"]
        alike = row["spread"] < 0.01 * row["se"]
        none = none or alike
        spread = f"{100 * row['spread']:.0f} %" if row["logarithmic"] else plain_number(row["spread"])
        spread = "0" if alike else spread
        rows.append(
            (
                name, plain_number(ends["value"]), f"{plain_number(ends['lower'])} … {plain_number(ends['upper'])}", spread,
                f"{plain_number(ends['next_lower'])} … {plain_number(ends['next_upper'])}", row["unit"], str(row["turbines"]),
            )
        )  # fmt: skip
    table = Table(
        f"{len(data['turbines'])} turbines: {', '.join(map(text_of, data['turbines']))}",
        ("parameter", "type", "95 %", "spread", "next turbine, 95 %", "unit", "n"),
        tuple(rows),
        left=(0, 5),
        note="Spread: standard deviation from turbine to turbine beyond the estimates' own uncertainty (REML)."
        + (f" {_ALIKE}" if none else ""),
    )
    without = (
        f"<p class=note>Left out, for they depart from the others by more than chance: {escape(', '.join(left_out))}.</p>"
        if left_out
        else ""
    )
    return section(
        "The type of turbine",
        tables_html((table, "")),
        without,
        figure_html("type", "Type and next turbine", "", lambda: figure_type(data)),
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _with_se(value: float, se: float | None) -> str:
    return plain_number(value) if se is None else f"{plain_number(value)} ± {plain_number(se, 2)}"


def _chance(p: float) -> str:
    return "< 0.0001" if p < 1e-4 else plain_number(p, 2)


def _foot(found: Mapping) -> str:
    lines = (
        "All parameters were estimated on the record's identification period by the innovations of the fit's own model. A "
        "group of parameters differs where the estimates are further apart than both covariances explain (forward "
        "selection, corrected for the number of groups) and where the difference matters: 10 % of a time constant, 0.05 of "
        "R_AT/(R_AT+R_IC), 0.3 K or 0.26 g/m³ in the simulation.",
        "Sensor offsets and disturbances belong to a logger, a site and a season: they are always estimated on the record.",
        "A model does not transfer where every group of the cabinet differs, where a re-estimated parameter ends at a bound, "
        "where even the record's own estimate errs by far more than the fit did at home, or where the re-estimated model "
        "is worse than a rule without a model, or than the fit as it is.",
    )
    made = f"Judged by hygrokf {text_of(found['version'])}; page written by hygrokf {__version__}."
    return f"<footer><h2>Method</h2>{''.join(f'<p>{prose(line)}</p>' for line in (*lines, made))}</footer>"


def transfer_text(found: Mapping) -> str:
    """The verdicts as text for the terminal."""
    lines = [f"{found['from']['name']}: {line}" for line in told(found["from"].get("verdicts"))]
    for one in found["records"]:
        lines += [f"{found['from']['name']} on {one['name']}: {one['sentence']}"]
        lines += [f"  {line}" for line in told(one.get("verdicts"))]
        lines += [f"  note: {line}" for line in one["statements"]]
        lines += [f"  {line}" for line in one["reasons"]]
        for row in one["groups"]:
            p = f" (p {_chance(row['p_adjusted'])})" if "p_adjusted" in row else ""
            lines.append(f"  {row['group']}: {row['statement']}{p}")
        for q, rows in one["rmse"].items():
            name, unit = QUANTITIES[q]
            cells = ", ".join(f"{SETS[n]} {fixed(_number(rows[n]['total']))}" for n in SETS if n in rows)
            lines.append(f"  RMSE of the {name} [{unit}], {one['period']}: {cells}")
        lines.append("")
    if found["type"] is not None:
        lines.append(f"type of {len(found['type']['turbines'])} turbines:")
        for name, row in found["type"]["type_parameters"].items():
            ends = row["in_unit"]
            lines.append(
                f"  {name}: {plain_number(ends['value'])} {row['unit']} ({plain_number(ends['lower'])} … "
                f"{plain_number(ends['upper'])}), next turbine {plain_number(ends['next_lower'])} … {plain_number(ends['next_upper'])}"
            )
    return "\n".join(lines).rstrip()
