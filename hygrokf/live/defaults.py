"""What a tracker runs on where no file says so: one turbine for each model, and signals under their own names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hygrokf.data.signals import SIGNALS
from hygrokf.identification.results import ResultFault, read_fit
from hygrokf.identification.verdict import inherited
from hygrokf.live.config import Config, ConfigFault
from hygrokf.live.plan import Form, plan
from hygrokf.live.properties import standard_errors
from hygrokf.live.sources.kinds import stream_of
from hygrokf.live.sources.payload import Field, Mapping
from hygrokf.live.storage.postgres import SCHEMES, url_fault
from hygrokf.live.table_reader import TableReader
from hygrokf.live.turbines import Turbine
from hygrokf.live.web.page_settings import PAGE, PageSettings, page_settings


def usual_mapping() -> Mapping:
    """Signals of the signal table under their own names, in the units that messages show (°C, %, kW, g/m³)."""
    fields = {}
    for name, row in SIGNALS.items():
        stepped = row.unit in ("W", "rad/s") or name == "preheating"
        fields[name] = Field(name, row.display or row.unit, Form("zero-order" if stepped else "linear"))
    return Mapping(fields)


def page_at(address: str | None) -> PageSettings:
    """The page at an address (None: the usual one).  Raises ConfigFault."""
    reader = TableReader()
    found = page_settings(address or PAGE, Path(), reader)
    if reader.faults:
        raise ConfigFault("--page", reader.faults)
    return found


def store_at(url: str) -> str:
    """A store's URL as it stands on the command line.  Raises ConfigFault, which does not show what may be a password."""
    wrong = url_fault(url)
    if wrong is None and not url.startswith(("sqlite:", *SCHEMES)):
        wrong = f"expected sqlite:PATH or postgresql://USER@HOST/NAME, found one that begins with {url.partition(':')[0]!r}"
    if wrong is not None:
        raise ConfigFault("--store", [wrong])
    return url


def usual_config(fits: Sequence[Path], sources: Sequence[str], store: str, page: PageSettings) -> Config:
    """A tracker of the turbines with these models, one each.  Raises ConfigFault with all that is wrong."""
    reader = TableReader()
    mapping = usual_mapping()
    forms = {one.signal: one.form for one in mapping.fields.values()}
    turbines: dict[str, Turbine] = {}
    for path in fits:
        try:
            fit = read_fit(path)
            made = plan(fit, forms=forms)
        except (ResultFault, ValueError, KeyError) as fault:
            reader.faults.append(str(fault))
            continue
        except OSError as fault:
            reader.faults.append(f"{path}: {fault.strerror}")
            continue
        if made.name in turbines:
            reader.faults.append(f"{path}: a second model of {made.name!r}; name turbines in a track.toml")
        turbines[made.name] = Turbine(made, errors=standard_errors(fit), verdicts=inherited(fit.results))
    # a payload need not name the only turbine that there is
    mapping = replace(
        mapping, turbine="" if len(turbines) == 1 else "turbine", turbines={name: name for name in turbines}
    )
    # a URL may hold a password: it is told by its number
    streams = [
        stream_of(table_of(url), f"--source {number}", Path(), mapping, reader)
        for number, url in enumerate(sources, start=1)
    ]
    if not sources:
        reader.faults.append(
            'no source: add --source "file:PATH", stdin or "mqtt://BROKER/TOPIC", or write a track.toml'
        )
    if reader.faults:
        raise ConfigFault("track", reader.faults)
    return Config(turbines, tuple(one for one in streams if one is not None), store, page)


def table_of(url: str) -> dict[str, object]:
    """The source's table that a URL alone stands for: behind an MQTT broker stands the topic filter."""
    scheme, _, rest = url.partition("://")
    broker, _, topic = rest.partition("/")
    if scheme in ("mqtt", "mqtts") and topic:
        return {"url": f"{scheme}://{broker}", "topics": [topic]}
    return {"url": url}
