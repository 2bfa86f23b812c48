"""`sightline live`."""

from __future__ import annotations

import hashlib
import itertools
import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sightline import signals
from sightline.cli.common import check_model_is_there, say, say_aside
from sightline.cli.defaults import DEFAULT_DETECTOR
from sightline.cli.options import (
    AreaOption,
    BasemapOption,
    BudgetOption,
    ClassesOption,
    ClockOption,
    EnlargeOption,
    MaskOption,
    StartOption,
    ThresholdOption,
    ViewsOption,
    detector_options,
)
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import parse_time
from sightline.errors import InputError, SightlineError
from sightline.stopping import Stop, call

if TYPE_CHECKING:
    from sightline.detection import Detector
    from sightline.georeferencing.georeferencer import Georeferencer
    from sightline.live.ais import AisMatcher
    from sightline.live.boundaries import BoundaryWatch
    from sightline.live.clips import ClipRecorder
    from sightline.live.config import LiveTable
    from sightline.live.journal import Journal
    from sightline.live.run import Camera, LiveRun
    from sightline.live.source import CameraSource, PlayedSource, SourceEvent
    from sightline.live.store import Keeper, Store
    from sightline.live.view import View
    from sightline.moment import Feed
    from sightline.web.hub import Hub
    from sightline.web.server import LiveServer

    _Feeds = dict[tuple[str, str], tuple[str, Feed]]

_Kind = Literal["nmea", "signalk", "cot", "mqtt", "webhook"]
_KINDS: tuple[_Kind, ...] = ("nmea", "signalk", "cot", "mqtt", "webhook")

_LOOKS_APART_S = 0.5

_Addresses = list[str] | None


def _feed_option(name: str, what: str) -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(
        name, metavar="URL", help=f"{what} May be given several times."
    )
    return option


def live(
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="SOURCE",
            help="A camera's address (rtsp://, rtmp://, srt://, http://, udp://), a video device, "
            "or with --as-live a video or a folder of frames.",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(metavar="MODEL", help="The fitted model of the camera.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="live.toml: all of this, and more; options go first."),
    ] = None,
    serve: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Serve the page and the moments.")
    ] = None,
    store: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the tracks; see sightline export.")
    ] = None,
    clips: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Keep a short clip of the pictures around each track, masked."
        ),
    ] = None,
    ais: Annotated[
        str | None,
        typer.Option(metavar="SOURCE", help="AIS beside it: a file that grows, tcp://, udp://."),
    ] = None,
    nmea: Annotated[_Addresses, _feed_option("--nmea", "NMEA 0183 TLL: tcp://, udp://.")] = None,
    signalk: Annotated[_Addresses, _feed_option("--signalk", "Signal K deltas.")] = None,
    cot: Annotated[_Addresses, _feed_option("--cot", "Cursor-on-Target, for TAK.")] = None,
    mqtt: Annotated[_Addresses, _feed_option("--mqtt", "One message a moment.")] = None,
    webhook: Annotated[
        _Addresses, _feed_option("--webhook", "A POST an alert: http://, https://.")
    ] = None,
    lines: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON LineString features, crossings are counted."),
    ] = None,
    zones: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON Polygon features, stays are counted."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Try source, model and outputs, and watch nothing.")
    ] = False,
    camera: Annotated[
        str | None, typer.Option("--name", metavar="NAME", help="Of the camera.")
    ] = None,
    as_live: Annotated[
        bool, typer.Option("--as-live", help="Play a recording at its own pace.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(metavar="FACTOR", help="How much faster a recording is played.", min=0.01),
    ] = None,
    clock: ClockOption = None,
    start_utc: StartOption = None,
    credentials: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="USER:PASSWORD of the camera in its first line; absent: SIGHTLINE_CREDENTIALS "
            "in the environment.",
        ),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Token of the page; absent: SIGHTLINE_TOKEN in the environment."
        ),
    ] = None,
    shore: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON of the shore, which the page's map shows."),
    ] = None,
    basemap: BasemapOption = None,
    log: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log as JSON lines; - for standard error."),
    ] = None,
    mask: MaskOption = None,
    area: AreaOption = None,
    detector: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE.onnx", help="motion, harbour, or a detector in an ONNX file."
        ),
    ] = None,
    classes: ClassesOption = None,
    threshold: ThresholdOption = None,
    views: ViewsOption = None,
    enlarge: EnlargeOption = None,
    budget: BudgetOption = None,
) -> None:
    """Watch a camera, and publish where its targets are.

    Ctrl-C or SIGTERM ends it within three seconds; what is kept is finished.
    """
    options: list[tuple[str, dict[str, object]]] = [
        ("source", {"address": source, "credentials": credentials, "speed": speed}),
        ("source", {"frame_clock": clock, "start_utc": start_utc, "as_live": as_live or None}),
        ("detector", {"name": detector, "threshold": threshold, "views": views}),
        ("detector", {"enlarge": enlarge, "budget_ms": budget}),
        ("detector", {"classes": classes.split(",") if classes else None}),
        ("store", {"file": store, "clips": clips}),
        ("server", {"address": serve, "token_file": token_file}),
        ("server", {"shore": shore, "basemap": basemap}),
        ("ais", {"source": ais}),
        ("log", {"file": log}),
        ("feeds", {"nmea": nmea, "signalk": signalk, "cot": cot, "mqtt": mqtt}),
        ("feeds", {"webhook": webhook}),
        ("boundaries", {"lines": lines, "zones": zones}),
        ("", {"model": model, "camera": camera, "mask": mask}),
        ("", {"area": [str(path) for path in area] if area else None}),
    ]

    def read() -> LiveTable:
        from sightline.live.config import LiveTable, read_live_config

        table = read_live_config(config) if config is not None else LiveTable()
        for section, given in options:
            _override(table, section, given)
        _check_table(table, config or Path("live.toml"))
        return table

    reread = threading.Event() if config is not None else None
    with signals.stoppable(reread) as stop:
        # There is always something to finish.
        stop.begun = True
        table = read()
        with ExitStack() as stack:
            session = _Session(table, stack)
            if check:
                session.check()
                return
            session.watch(stop, reread, read)


def _check_table(table: LiveTable, where: Path) -> None:
    """Raise for what can be seen to be wrong before anything is opened.

    Raises:
        InputError: Source or model are missing, an address is none, or a file that is read would
            be written.
    """
    if table.source.address is None:
        raise InputError(
            f"no source is given; give a camera's address, or address in {where} ([source])"
        )
    if table.model is None:
        raise InputError(f"no model is given; give --model MODEL, or model in {where}")
    check_model_is_there(Path(table.model))
    _check_files(table, where)
    _check_addresses(table)


def _check_files(table: LiveTable, where: Path) -> None:
    """Raise where what is kept or logged would go into a file that is read.

    Raises:
        InputError: It would, or both would go into one file.
    """
    log = table.log.file if table.log.file != "-" else None
    keep_apart(
        [Path(file) for file in (table.store.file, log) if file is not None],
        [
            *(where, table.source.address, table.source.credentials, table.source.frame_clock),
            *(table.model, table.detector.name, table.mask, *table.area, table.ais.source),
            *(table.server.token_file, table.server.shore, table.server.basemap),
            *(table.boundaries.lines, table.boundaries.zones),
        ],
    )


def _override(table: LiveTable, section: str, given: Mapping[str, object]) -> None:
    """Put the options that were given into the place of what the configuration has."""
    where = getattr(table, section) if section else table
    for name, value in given.items():
        if value is not None:
            setattr(where, name, str(value) if isinstance(value, Path) else value)


class _Session:
    """One watching: everything is opened in the order in which it can be refused."""

    def __init__(self, table: LiveTable, stack: ExitStack) -> None:
        from sightline.georeferencing.georeferencer import load_model
        from sightline.live.journal import Journal, JournalHandler
        from sightline.text import without_secrets

        self._table, self._stack = table, stack
        self._hub: Hub | None = None
        self._clips: ClipRecorder | None = None
        self._matcher: AisMatcher | None = None
        self._address = table.source.address or ""
        self._name = without_secrets(self._address)
        self._model: Georeferencer = load_model(Path(table.model or ""))
        self._journal: Journal = Journal(Path(table.log.file) if table.log.file else None)
        stack.callback(self._journal.close)
        handler = JournalHandler(self._journal)
        logging.getLogger("sightline").addHandler(handler)
        stack.callback(logging.getLogger("sightline").removeHandler, handler)
        self._camera = self._made_camera(table)
        self._source = self._made_source()
        stack.callback(self._source.close)

    def check(self) -> None:
        """Try everything, and say what is wrong.

        Raises:
            InputError: Something is.
        """
        table, wrong = self._table, []
        say(f"model: {table.model}, {self._model.model}, for pictures of {self._size()} px")

        def attempt(what: str, action: Callable[[], str]) -> None:
            try:
                say(f"{what}: {action()}")
            except SightlineError as error:
                wrong.append(str(error))

        attempt("source", self._probed)
        for kind in _KINDS:
            for url in getattr(table.feeds, kind):
                attempt(kind, lambda kind=kind, url=url: self._tried(kind, url))  # type: ignore[misc]
        if table.store.file is not None:
            attempt("store", self._tried_store)
        if table.store.clips is not None:
            attempt("clips", self._tried_clips)
        if table.server.address is not None:
            attempt("page", self._tried_server)
        if wrong:
            raise InputError("; ".join(wrong))
        say("all is well")

    def watch(
        self, stop: Stop, reread: threading.Event | None, read: Callable[[], LiveTable]
    ) -> None:
        """Watch until somebody asks to stop.

        Args:
            stop: Is set by whoever asks.
            reread: Is set by whoever wants the configuration to be read again.
            read: Reads it.
        """
        from sightline.formats.tiles import open_tiles
        from sightline.live.ais import AisReceiver
        from sightline.live.on_the_map import PictureOnMap
        from sightline.live.run import EarlierRun, LiveRun
        from sightline.live.store import Keeper, KeptMoments

        table = self._table
        store = self._opened_store()
        keeper = None
        earlier = EarlierRun()
        if store is not None:
            earlier = EarlierRun(store.highest_id(), store.kept_state())
            keeper = Keeper(
                store,
                retention_days=table.store.retention_days,
                told=lambda text: self.told("store", text),
            )
        clips = self._opened_clips()
        if table.server.basemap is not None:
            open_tiles(table.server.basemap).close()
        feeds = self._opened_feeds(table, {})
        call(self._probed, stop)
        matcher = None
        if table.ais.source is not None:
            matcher = self._made_matcher(store)
            receiver = AisReceiver(table.ais.source, matcher)
            self._stack.callback(receiver.close)
            receiver.start()
        run = LiveRun(
            self._source,
            self._camera,
            feeds=dict(feeds.values()),
            keeper=keeper,
            earlier=earlier,
            told=self.told,
            ais=matcher,
        )
        if clips is not None:
            run.record(clips)
        if table.server.address is not None:
            server = self._opened_server(run.health, run.picture)
            watch = self._camera.boundaries
            server.hub.boundaries = None if watch is None else watch.geojson()
            server.hub.on_the_map = PictureOnMap(self._model, run.newest, table.water_level_m)
            if table.store.file is not None:
                server.hub.kept = KeptMoments(Path(table.store.file))
            run.add_feed("page", server)
            server.start()
            self._hub = server.hub
        if reread is not None:
            rereader = threading.Thread(
                target=self._reread, args=(run, keeper, feeds, stop, reread, read), daemon=True
            )
            rereader.start()
        say(f"watching {self._name}; Ctrl-C ends it")
        run.run(stop)
        health = run.health()
        say(
            f"watched for {health['uptime_s']} s: {health['frames_seen']} frames, "
            f"{health['frames_processed']} processed, {health['frames_left_out']} left out, "
            f"{health['reconnections']} reconnections"
        )

    def _reread(
        self,
        run: LiveRun,
        keeper: Keeper | None,
        feeds: _Feeds,
        stop: Stop,
        reread: threading.Event,
        read: Callable[[], LiveTable],
    ) -> None:
        """Take another configuration whenever that is asked for; a wrong one changes nothing."""
        while not stop.is_set():
            if not reread.wait(_LOOKS_APART_S):
                continue
            reread.clear()
            try:
                self.told("reloaded", self._change(run, keeper, feeds, read()))
            except SightlineError as error:
                self.told("not-reloaded", f"{error}; all stays as it was")
            # Whatever it is, it is no reason for the camera not to be watched.
            except Exception as error:
                self.told("not-reloaded", f"{error!r}; all stays as it was")

    def _change(self, run: LiveRun, keeper: Keeper | None, feeds: _Feeds, table: LiveTable) -> str:
        """Watch as another configuration says; returns what that changes, in words."""
        from sightline.live.config import changed_keys

        at_once, later = changed_keys(self._table, table)
        same = not any(key.startswith("detector.") for key in at_once)
        camera = self._made_camera(table, self._camera.detector if same else None)
        new = self._opened_feeds(table, feeds)
        for name, feed in new.values():
            run.add_feed(name, feed)
        wanted = {(kind, url) for kind in _KINDS for url in getattr(table.feeds, kind)}
        for key in [one for one in feeds if one not in wanted]:
            run.remove_feed(feeds.pop(key)[0])
        feeds.update(new)
        run.change(camera)
        if self._matcher is not None:
            self._matcher.change(self._view_of(camera))
        if keeper is not None:
            keeper.change(table.store.retention_days)
        if self._clips is not None:
            self._clips.change(table.store.retention_days)
        if self._hub is not None:
            watch = camera.boundaries
            self._hub.boundaries = None if watch is None else watch.geojson()
        self._camera = camera
        # What wants a restart is told again until there is one.
        for changed in at_once:
            _set(self._table, changed, _get(table, changed))
        told = f"changed: {', '.join(at_once) or 'nothing but what files hold'}"
        if later:
            told += f"; only a restart changes {', '.join(later)}"
        return told

    def told(self, kind: str, text: str) -> None:
        """Log an event, and show it where nobody asked for a log on standard error."""
        self._journal.write(kind, text)
        if self._table.log.file != "-" and kind not in ("status", "connected"):
            say_aside(f"{kind}:", text, "yellow")

    def _event(self, event: SourceEvent) -> None:
        self.told(event.kind, event.text)

    def _size(self) -> str:
        width, height = self._model.image_size_px
        return f"{width} x {height}"

    def _made_camera(self, table: LiveTable, detector: Detector | None = None) -> Camera:
        from sightline import formats
        from sightline.live.run import Camera
        from sightline.live.state import StateSettings
        from sightline.pipeline.sources import make_detector
        from sightline.video.mask import read_mask

        if self._model.moving:
            raise InputError(
                f"{table.model}: is the model of a camera on a platform that moves, which cannot "
                "be watched live; give one of a camera that stands still"
            )
        self._model.check_water(table.water_level_m is not None, f"{table.model}: ")
        mask = read_mask(table.mask) if table.mask else None
        if mask is not None:
            mask.check_size(self._model.image_size_px, "the model")
        options = table.detector
        looking = detector_options(
            None,
            ",".join(options.classes) if options.classes else None,
            options.threshold,
            None,
            options.views,
            enlarge=options.enlarge,
            budget=options.budget_ms,
        )
        return Camera(
            name=table.camera,
            model=self._model,
            detector=detector
            or make_detector(options.name or DEFAULT_DETECTOR, self._model, looking),
            mask=mask,
            area=formats.read_area([Path(one) for one in table.area]) if table.area else None,
            water_level_m=table.water_level_m,
            targets=StateSettings(**table.targets.model_dump()),
            silent_s=table.source.silent_s,
            boundaries=self._made_boundaries(table),
        )

    def _made_boundaries(self, table: LiveTable) -> BoundaryWatch | None:
        from sightline import formats
        from sightline.live.boundaries import BoundaryLimits, BoundaryWatch

        own = table.boundaries
        if own.lines is None and own.zones is None:
            return None
        return BoundaryWatch(
            self._model.plane,
            lines=formats.read_lines(own.lines) if own.lines is not None else None,
            zones=formats.read_zones(own.zones) if own.zones is not None else None,
            limits=BoundaryLimits(own.speed_mps, own.dwell_s),
        )

    def _made_source(self) -> CameraSource | PlayedSource:
        from sightline import formats
        from sightline.live.config import with_credentials
        from sightline.live.source import CameraSource, PlayedSource, SourceSettings
        from sightline.video.containers import check_camera

        own = self._table.source
        settings = SourceSettings(
            size_px=self._model.image_size_px,
            options=own.options,
            clock=own.clock,
            largest_clock_error_s=own.largest_clock_error_s,
            open_s=own.open_s,
            silent_s=own.silent_s,
            frozen_s=own.frozen_s,
            black_s=own.black_s,
            longest_wait_s=own.longest_wait_s,
        )
        if own.as_live:
            if "://" in self._address or not Path(self._address).exists():
                raise InputError(f"{self._name}: there is no such video or folder to be played")
            return PlayedSource(
                Path(self._address),
                settings,
                self._event,
                clock=formats.read_clock(own.frame_clock) if own.frame_clock else None,
                start_utc_s=parse_time("--start-utc", own.start_utc),
                speed=own.speed,
            )
        if "://" not in self._address and Path(self._address).is_file():
            raise InputError(
                f"{self._name}: is a recording, no camera; give --as-live to have it played as one"
            )
        check_camera(self._address, self._name)
        address = with_credentials(self._address, own.credentials)
        return CameraSource(address, settings, self._event)

    def _probed(self) -> str:
        size_px = self._source.probe()
        if size_px != self._model.image_size_px:
            raise InputError(
                f"{self._name}: its pictures have {size_px[0]} x {size_px[1]} px, the model "
                f"learned from {self._size()} px; fit one to pictures of this size"
            )
        return f"{self._name}, {size_px[0]} x {size_px[1]} px"

    def _opened_feeds(self, table: LiveTable, open_already: _Feeds) -> _Feeds:
        """Those that are not open, by kind and URL, each with what it is called."""
        made: _Feeds = {}
        names = {name for name, _ in open_already.values()}
        for kind in _KINDS:
            for url in getattr(table.feeds, kind):
                if (kind, url) in open_already or (kind, url) in made:
                    continue
                try:
                    feed = self._opened_feed(kind, url)
                except SightlineError:
                    for _, other in made.values():
                        other.close()
                    raise
                # Where it comes to nothing; closed by then, it does nothing.
                self._stack.callback(feed.close)
                made[kind, url] = _free(kind, names), feed
                names.add(made[kind, url][0])
        return made

    def _opened_feed(self, kind: _Kind, url: str) -> Feed:
        from sightline.live.feeds import open_feed

        feed: Feed = open_feed(url, kind=kind, camera=self._table.camera)
        return feed

    def _made_matcher(self, store: Store | None) -> AisMatcher:
        from sightline.live.ais import AisMatcher
        from sightline.live.ais_check import ModelCheck

        level_m, view = self._table.water_level_m, self._view_of(self._camera)
        before = store.checks() if store is not None else []
        check = ModelCheck(self._model, water_level_m=level_m, before=before, told=self.told)
        self._matcher = AisMatcher(self._model.plane, view=view, check=check, told=self.told)
        return self._matcher

    def _view_of(self, camera: Camera) -> View:
        from sightline.live.view import View

        level_m = camera.water_level_m
        return View(self._model, area=camera.area, mask=camera.mask, water_level_m=level_m)

    def _tried(self, kind: _Kind, url: str) -> str:
        from sightline.text import without_secrets

        self._opened_feed(kind, url).close()
        return without_secrets(url)

    def _opened_store(self) -> Store | None:
        from sightline.live.store import Store

        if self._table.store.file is None:
            return None
        content = Path(self._table.model or "").read_bytes()
        return Store(
            self._table.store.file,
            camera=self._table.camera,
            plane=self._model.plane,
            model=hashlib.sha256(content).hexdigest()[:16],
        )

    def _tried_store(self) -> str:
        from sightline.live.store import check_store

        path = Path(self._table.store.file or "")
        if path.exists():
            # It may be in use.
            check_store(path)
            return f"{path}"
        store = self._opened_store()
        if store is not None:
            store.close()
        return f"{path}, made"

    def _opened_clips(self) -> ClipRecorder | None:
        """What takes clips, where somebody asked for them."""
        from sightline.live.clips import ClipRecorder

        own = self._table.store
        if own.clips is None:
            return None
        self._clips = ClipRecorder(
            Path(own.clips),
            retention_days=own.retention_days,
            told=lambda text: self.told("clips", text),
        )
        return self._clips

    def _opened_server(
        self,
        health: Callable[[], dict[str, object]] | None,
        picture: Callable[[], bytes | None] | None,
    ) -> LiveServer:
        from sightline.live.config import page_token
        from sightline.web.server import LiveServer

        table = self._table
        return LiveServer(
            table.server.address or "",
            token=page_token(table.server.token_file),
            health=health,
            picture=picture,
            store=Path(table.store.file) if table.store.file else None,
            shore=Path(table.server.shore) if table.server.shore else None,
            basemap=Path(table.server.basemap) if table.server.basemap else None,
        )

    def _tried_clips(self) -> str:
        self._opened_clips()
        return f"{self._table.store.clips}"

    def _tried_server(self) -> str:
        server = self._opened_server(None, None)
        server.start()
        server.close()
        return f"http://{self._table.server.address}"


def _free(kind: str, used: set[str]) -> str:
    names = (kind if number == 1 else f"{kind}-{number}" for number in itertools.count(1))
    return next(name for name in names if name not in used)


def _get(table: LiveTable, key: str) -> object:
    return reduce(getattr, key.split("."), table)


def _set(table: LiveTable, key: str, value: object) -> None:
    *sections, name = key.split(".")
    setattr(reduce(getattr, sections, table), name, value)


def _check_addresses(table: LiveTable) -> None:
    """Raise where an address is none, before anything is loaded.

    Raises:
        InputError: One is.
    """
    if table.server.address is not None:
        from sightline.addresses import parse_address

        parse_address(table.server.address)
    if table.ais.source is not None:
        from sightline.live.ais import check_ais

        check_ais(table.ais.source)
    for kind in _KINDS:
        for url in getattr(table.feeds, kind):
            if "://" not in url:
                raise InputError(f"--{kind} {url!r}: is no address; expected for example tcp://...")
