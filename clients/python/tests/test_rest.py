"""Resources of the REST interface."""

import asyncio
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import trustme

from sightfix import (
    AsyncClient,
    BoundingBox,
    Client,
    ConflictError,
    ConnectionFailedError,
    CsvLayout,
    Fix,
    ImageSize,
    InvalidRequestError,
    JobFailedError,
    NotFoundError,
    Observation,
    PermissionDeniedError,
    RetryPolicy,
    RevisionMismatchError,
    Sample,
    UnauthenticatedError,
    WaitTimeoutError,
)
from sightfix.models import GeometryLineString, Rule, SiteTrainingRun, TrackUpdate, TrainingRun
from tests.conftest import ServerProcess, admin_key

NOON = datetime(2026, 1, 1, 12, tzinfo=UTC)


def sample(second: int, width_px: float = 30.0, target_id: str = "person-1") -> Sample:
    return Sample(
        time=NOON + timedelta(seconds=second),
        target_id=target_id,
        bounding_box=BoundingBox(left_px=240.0 + second, top_px=100.0, width_px=width_px, height_px=80.0),
        fix=Fix(longitude_deg=24.7, latitude_deg=59.4),
    )


def test_from_an_empty_server_to_a_report(
    client: Client, recording: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    training, test = recording
    camera = client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
    assert (camera.revision, camera.active_model, camera.image_size) == (
        1,
        None,
        ImageSize(width_px=1280, height_px=720),
    )
    imported = client.samples.import_file("square", training)
    assert (imported.accepted, imported.rejected, imported.durability) == (240, 0, "synced")
    again = client.samples.import_file("square", training, durability="relaxed")
    assert (again.accepted, again.duplicate) == (0, 240)

    states: list[TrainingRun] = []
    run = client.training_runs.start("square", recipe="hybrid", epochs=40, seed=7)
    ended = client.training_runs.wait(run, progress=True, on_progress=states.append)
    assert (ended.model_version, ended.seed, ended.state) == (1, 7, "succeeded")
    assert states[-1] == ended
    assert "succeeded" in capsys.readouterr().err
    assert client.training_runs.log("square", run.id)
    assert len(client.training_runs.curve("square", run.id)) == 40
    assert [it.id for it in client.training_runs.list("square")] == [run.id]

    assert client.models.active("square").number == 1
    observation = Observation(time=NOON, bounding_box=sample(1).bounding_box)
    assert client.fusions.fuse("square", observation).flags[0] == "gnss_denied"

    client.samples.import_file("square", test)
    evaluation = client.evaluations.start(camera_id="square", seeds=1, methods=["gnss", "homography.denied"])
    report = client.evaluations.wait(evaluation).report
    assert report is not None
    assert report.methods["homography.denied"].n > 0
    assert [it.id for it in client.evaluations.list(camera_id="square")] == [evaluation.id]
    client.evaluations.delete(evaluation.id)
    assert list(client.evaluations.list()) == []
    assert [it.camera.id for it in client.cameras.statuses()] == ["square"]
    assert client.cameras.learning("square").state == "learned"
    assert client.server().limits["batch_observations"] == 1000


def test_rejected_rows_are_counted_over_all_requests(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    client.cameras.create(id="yard")
    for module in ("_sync", "_async"):
        monkeypatch.setattr(f"sightfix.{module}.samples.ROWS_PER_REQUEST", 2)
    rows = [sample(0), sample(1), sample(2, width_px=-1.0), sample(3), sample(4, width_px=0.0)]
    imported = client.samples.import_samples("yard", rows)
    assert (imported.accepted, imported.rejected) == (3, 2)
    assert [(row.line, row.field) for row in imported.rejected_rows] == [
        (3, "bounding_box.width_px"),
        (5, "bounding_box.width_px"),
    ]
    assert client.samples.import_samples("yard", []).accepted == 0


def test_samples_are_listed_selected_exported_and_deleted(client: Client, tmp_path: Path) -> None:
    client.cameras.create(id="yard")
    samples = [sample(second) for second in range(5)] + [sample(1, target_id="=SUM(A1)")]
    client.samples.import_samples("yard", samples)
    assert sorted(client.samples.list("yard", page_size=2), key=lambda it: (it.target_id, it.time)) == sorted(
        samples, key=lambda it: (it.target_id, it.time)
    )
    begin, end = NOON + timedelta(seconds=1), NOON + timedelta(seconds=3)
    assert client.samples.count("yard", from_=begin, until=end).count == 3
    client.samples.export("yard", tmp_path / "export.csv", target_id="person-1")
    assert len((tmp_path / "export.csv").read_text().splitlines()) == 6
    with pytest.raises(ValueError, match=r"\.csv"):
        client.samples.export("yard", tmp_path / "export.xlsx")
    assert client.samples.delete("yard", target_id="=SUM(A1)") == 1
    with pytest.raises(InvalidRequestError):
        client.samples.delete("yard")
    # An export can be imported as it is.
    assert client.samples.import_file("yard", tmp_path / "export.csv").duplicate == 5


def test_boxes_and_fixes_of_two_files_are_paired(client: Client, tmp_path: Path) -> None:
    client.cameras.create(id="yard")
    boxes, fixes = tmp_path / "boxes.csv", tmp_path / "fixes.csv"
    boxes.write_text("time,target_id,left,top,width,height\n2026-01-01T12:00:00Z,a,1,2,3,4\n")
    fixes.write_text("time,target_id,longitude,latitude\n2026-01-01T12:00:00.2Z,a,24.7,59.4\n")
    paired = client.samples.pair_files("yard", boxes, fixes, window_s=0.5, estimate_offset=False)
    assert (paired.accepted, paired.pairing.paired) == (1, 1)


def test_problems_are_typed(client: Client) -> None:
    with pytest.raises(NotFoundError, match="yard") as not_found:
        client.cameras.get("yard")
    assert (not_found.value.kind, not_found.value.problem.status) == ("camera-not-found", 404)
    assert not_found.value.problem.trace_id
    client.cameras.create(id="yard")
    with pytest.raises(ConflictError):
        client.cameras.create(id="yard")
    with pytest.raises(InvalidRequestError) as invalid:
        client.cameras.create(id="other", image_size=ImageSize(width_px=0, height_px=720))
    assert [it.field for it in invalid.value.violations] == ["image_size.width_px"]
    with pytest.raises(ConflictError) as no_model:
        client.fusions.fuse("yard", Observation(time=NOON, bounding_box=sample(1).bounding_box))
    assert no_model.value.kind == "no-model"
    client.samples.import_samples("yard", [sample(second) for second in range(40)])
    with pytest.raises(InvalidRequestError) as unusable:
        client.training_runs.start("yard")
    assert unusable.value.kind == "unusable-samples"


def test_a_job_that_does_not_succeed_is_an_error(client: Client, recording: tuple[Path, Path]) -> None:
    client.cameras.create(id="square")
    client.samples.import_file("square", recording[0])
    run = client.training_runs.start("square", recipe="paper", epochs=10_000)
    with pytest.raises(WaitTimeoutError):
        client.training_runs.wait(run, timeout_s=0.0)
    with pytest.raises(ConflictError):
        client.training_runs.start("square")
    client.training_runs.cancel("square", run.id)
    with pytest.raises(JobFailedError) as failed:
        client.training_runs.wait(run)
    assert failed.value.job.state == "cancelled"


def test_lists_are_read_page_by_page(client: Client) -> None:
    for number in range(5):
        client.cameras.create(id=f"gate-{number}")
    assert [it.id for it in client.cameras.list(page_size=2)] == [f"gate-{number}" for number in range(5)]
    assert next(client.cameras.list(page_size=2)).id == "gate-0"
    client.cameras.delete("gate-0")
    assert next(client.cameras.list()).id == "gate-1"


def test_changes_are_based_on_a_revision(client: Client) -> None:
    camera = client.cameras.create(id="yard", display_name="Yard", labels={"site": "north", "floor": "1"})
    changed = client.cameras.update(
        "yard", revision=camera.revision, display_name=None, gnss_bias_sigma_m=1.5, labels={"floor": None}
    )
    assert (changed.display_name, changed.gnss_bias_sigma_m, changed.labels) == (
        "yard",
        1.5,
        {"site": "north"},
    )
    with pytest.raises(RevisionMismatchError):
        client.cameras.update("yard", revision=camera.revision, display_name="again")
    assert client.cameras.update("yard", display_name="again").revision == 3


def test_a_picture_is_set_and_removed(client: Client) -> None:
    client.cameras.create(id="seen")
    assert client.cameras.picture("seen") is None
    for picture in (b"\xff\xd8\xff rest", b"\x89PNG\r\n\x1a\n rest"):
        client.cameras.set_picture("seen", picture)
        assert client.cameras.picture("seen") == picture
    client.cameras.delete_picture("seen")
    assert client.cameras.picture("seen") is None


def test_models_are_copied_activated_and_rolled_back(trained: ServerProcess, client: Client) -> None:
    with Client(trained.url) as source:
        file = source.models.download("square", 1)
        assert b"boxes_to_positions" in source.models.download("square", 1, file_format="onnx")
    client.cameras.create(id="copy")
    for number in (1, 2):
        assert client.models.import_file("copy", file).number == number
        client.models.activate("copy", number)
    assert client.models.roll_back("copy").number == 1
    client.models.delete("copy", 2)
    assert [it.number for it in client.models.list("copy")] == [1]
    with pytest.raises(InvalidRequestError):
        client.models.import_file("copy", file[:-1])


def test_tracks_are_followed_and_watched(trained: ServerProcess) -> None:
    now = datetime.now(UTC)
    observations = [
        Observation(
            time=now + timedelta(seconds=second - 5),
            target_id="walker",
            fix=Fix(longitude_deg=24.745, latitude_deg=59.437),
        )
        for second in range(5)
    ]
    with Client(trained.url) as client, Client(trained.url) as watcher:
        events = watcher.tracks.watch("square")
        seen: list[object] = []
        reader = threading.Thread(target=lambda: seen.append(next(events)), daemon=True)
        reader.start()
        while not seen:
            assert len(client.tracks.follow("square", observations)) == 5
            reader.join(0.2)
        assert isinstance(seen[0], TrackUpdate)
        assert seen[0].properties.target_id == "walker"
        assert "walker" in [it.properties.target_id for it in client.tracks.list("square")]
        assert len(client.tracks.history("square", "walker")) >= 1


def test_a_site_tracks_targets_over_its_cameras(trained: ServerProcess) -> None:
    fix = Fix(longitude_deg=24.745, latitude_deg=59.437)
    with Client(trained.url) as client:
        site = client.sites.create(id="harbour", labels={"owner": "port"})
        changed = client.sites.update("harbour", revision=site.revision, display_name="Harbour", labels={"owner": None})
        assert (changed.display_name, changed.labels) == ("Harbour", {})
        with pytest.raises(RevisionMismatchError):
            client.sites.update("harbour", revision=site.revision, display_name="again")
        client.cameras.update("square", site="harbour")
        assert [it.cameras for it in client.sites.list()] == [1]
        tracks = client.sites.tracks("harbour")
        while not tracks:
            now = datetime.now(UTC)
            client.tracks.follow("square", [Observation(time=now, target_id="visitor", fix=fix)])
            tracks = client.sites.tracks("harbour")
        assert client.sites.history("harbour", tracks[0].id)
        client.cameras.update("square", site=None)
        client.sites.delete("harbour")
        with pytest.raises(NotFoundError):
            client.sites.get("harbour")


def test_a_place_reports_who_crosses_it(client: Client) -> None:
    client.cameras.create(id="gate")
    line = GeometryLineString(type="LineString", coordinates=[[24.745, 59.4365], [24.745, 59.4375]])
    rules = [Rule(id="over", kind="cross")]
    place = client.places.create(id="line", camera_id="gate", geometry=line, rules=rules)
    assert (place.geometry, place.probability, place.rules) == (line, 0.95, rules)
    changed = client.places.update("line", revision=place.revision, display_name="Line")
    assert [it.display_name for it in client.places.list(camera="gate")] == [changed.display_name] == ["Line"]
    with pytest.raises(InvalidRequestError):
        client.places.update("line", radius_m=3.0)
    start = datetime.now(UTC) - timedelta(minutes=2)
    drives = 0
    # A place is evaluated within a second or two after it was changed.
    while not (events := list(client.places.events(place="line"))):
        drives += 1
        for step in range(30):
            fix = Fix(longitude_deg=24.7435 + 0.0001 * step, latitude_deg=59.437, sigma_m=0.5)
            time = start + timedelta(seconds=step)
            client.tracks.follow("gate", [Observation(time=time, target_id=f"car-{drives}", fix=fix)])
    assert (events[0].kind, events[0].direction, events[0].camera_id) == ("cross", "left_to_right", "gate")
    assert abs(events[0].time - start - timedelta(seconds=15)) < timedelta(seconds=1)
    watched = next(client.places.watch(kind="cross", resume_after="0"))
    assert watched.event == events[0]
    counted = client.places.statistics("line", interval="hour", from_=start - timedelta(hours=1))
    assert counted.total.left_to_right.count >= 1
    client.places.delete("line")
    with pytest.raises(NotFoundError):
        client.places.get("line")


def site_with_samples(client: Client, files: dict[str, Path]) -> None:
    client.sites.create(id="street")
    for camera, file in files.items():
        client.cameras.create(id=camera, site="street", image_size=ImageSize(width_px=1280, height_px=720))
        assert client.samples.import_file(camera, file).rejected == 0


def test_the_cameras_of_a_site_are_trained_together(
    client: Client, site_recording: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    site_with_samples(client, site_recording)
    states: list[SiteTrainingRun] = []
    run, again = (client.site_training_runs.start("street", seed=3, idempotency_key="tonight") for _ in range(2))
    assert run.id == again.id
    ended = client.site_training_runs.wait(run, progress=True, on_progress=states.append, poll_s=0.05)
    assert (ended.state, ended.seed, ended.site_id, states[-1]) == ("succeeded", 3, "street", ended)
    assert ended.progress.epoch == ended.progress.epochs > 0
    assert "succeeded" in capsys.readouterr().err
    report = ended.report
    assert report is not None
    assert [(it.camera_id, it.model_version) for it in report.cameras] == [("c1", 1), ("c2", 1)]
    assert report.is_activated
    assert [client.cameras.get(camera).active_model for camera in site_recording] == [1, 1]
    assert report.disagreement_m is not None
    assert report.disagreement_apart_m is not None
    assert 0 < report.disagreement_m < report.disagreement_apart_m
    assert ended.report_text
    assert [it.id for it in client.site_training_runs.list("street")] == [run.id]
    assert client.site_training_runs.get("street", run.id) == ended
    with pytest.raises(ConflictError):
        client.site_training_runs.cancel("street", run.id)


def test_a_run_of_a_site_is_cancelled_or_refused(client: Client, site_recording: dict[str, Path]) -> None:
    client.sites.create(id="empty")
    with pytest.raises(InvalidRequestError) as refused:
        client.site_training_runs.start("empty")
    assert refused.value.kind == "unusable-samples"
    with pytest.raises(NotFoundError):
        next(client.site_training_runs.list("elsewhere"))
    site_with_samples(client, site_recording)
    with pytest.raises(InvalidRequestError):
        client.site_training_runs.start("street", from_=NOON + timedelta(days=10_000))
    run = client.site_training_runs.start("street")
    with pytest.raises(ConflictError):
        client.site_training_runs.start("street")
    with pytest.raises(WaitTimeoutError):
        client.site_training_runs.wait(run, timeout_s=0.0)
    client.site_training_runs.cancel("street", run.id)
    with pytest.raises(JobFailedError) as failed:
        client.site_training_runs.wait(run)
    assert failed.value.job.state == "cancelled"
    assert [client.cameras.get(camera).active_model for camera in site_recording] == [None, None]


def test_events_of_a_site_are_watched(server: ServerProcess) -> None:
    with Client(server.url) as client:
        client.sites.create(id="mall")
        client.cameras.create(id="gate", site="mall")

        def follow() -> None:
            for second in range(6):
                fix = Fix(longitude_deg=24.7, latitude_deg=59.4 + second * 1e-5, sigma_m=2.0)
                moment = NOON + timedelta(seconds=second)
                client.tracks.follow("gate", [Observation(time=moment, target_id="a", fix=fix)])

        timer = threading.Timer(0.5, follow)
        timer.start()
        names = []
        for event in client.sites.watch("mall"):
            names.append(event.name)
            assert event.id
            if "track" in names:
                break
        timer.join()
        assert names[0] in ("track_started", "track")


def test_columns_conflicts_and_keys_of_imports(client: Client, tmp_path: Path) -> None:
    client.cameras.create(id="gate")
    detections = tmp_path / "export.csv"
    detections.write_text(
        "Timestamp,x1,y1,x2,y2,lon,lat\n2026-01-01T00:00:00Z,10,20,40,90,24.7,59.4\n"
        "2026-01-01T00:00:01Z,11,20,41,90,24.7,59.4\n"
    )
    columns = {
        "time": "Timestamp",
        "left": "x1",
        "top": "y1",
        "width": "x2",
        "height": "y2",
        "longitude": "lon",
        "latitude": "lat",
    }
    layout = CsvLayout(columns=columns, box_form="corners")
    stored = [
        client.samples.import_file("gate", detections, layout=layout, target_id="a", idempotency_key="first")
        for _ in range(2)
    ]
    assert stored[0] == stored[1], "the second answer is that of the first"
    assert (stored[0].accepted, stored[0].rejected) == (2, 0)
    assert [it.bounding_box.width_px for it in client.samples.list("gate")] == [30.0, 30.0]
    moved = [
        Sample(
            time=it.time, target_id="a", bounding_box=it.bounding_box, fix=Fix(longitude_deg=25.0, latitude_deg=59.0)
        )
        for it in client.samples.list("gate")
    ]
    assert client.samples.import_samples("gate", moved).duplicate == 2
    assert client.samples.import_samples("gate", moved, on_conflict="replace").replaced == 2
    longitudes = [it.fix.longitude_deg for it in client.samples.list("gate") if it.fix is not None]
    assert longitudes == [25.0, 25.0]


def test_runs_have_idempotency_keys_and_followed_observations_are_stored(
    client: Client, recording: tuple[Path, Path]
) -> None:
    client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
    client.samples.import_file("square", recording[0])
    runs = [
        client.training_runs.start("square", recipe="projective", epochs=20, idempotency_key="night") for _ in range(2)
    ]
    assert runs[0].id == runs[1].id
    before = client.samples.count("square").count
    box = BoundingBox(left_px=240.0, top_px=100.0, width_px=30.0, height_px=80.0)
    fix = Fix(longitude_deg=24.7, latitude_deg=59.4)
    observation = Observation(time=NOON, target_id="walker", bounding_box=box, fix=fix)
    followed = client.tracks.follow_and_store("square", [observation], durability="relaxed")
    assert followed.stored is not None
    assert followed.stored.in_samples == 1
    assert client.samples.count("square").count == before + 1


def test_keys_have_roles_and_can_be_revoked(tmp_path: Path) -> None:
    secret = admin_key()
    server = ServerProcess(tmp_path, environment={"SIGHTFIX_ADMIN_KEY": secret})
    server.start()
    try:
        with pytest.raises(UnauthenticatedError), Client(server.url) as stranger:
            stranger.cameras.list().__next__()
        with Client(server.url, api_key=secret) as admin:
            admin.cameras.create(id="yard")
            key = admin.keys.create(name="box 7", role="edge", camera_ids=["yard"])
            with Client(server.url, api_key=key.secret) as edge:
                edge.samples.import_samples("yard", [sample(1)])
                with pytest.raises(PermissionDeniedError):
                    edge.cameras.delete("yard")
                admin.keys.revoke(key.id)
                with pytest.raises(UnauthenticatedError):
                    edge.samples.import_samples("yard", [sample(2)])
            assert admin.keys.get(key.id).revoked_at is not None
            actions = [it.action for it in admin.keys.audit_entries(page_size=1)]
            assert actions[0] == "key-revoked"
            assert secret not in repr(admin._settings)
    finally:
        server.stop()


def test_tls_is_verified_by_the_given_authority(tmp_path: Path) -> None:
    authority = trustme.CA()
    certificate = authority.issue_cert("localhost", "127.0.0.1")
    chain, key, ca_file = tmp_path / "chain.pem", tmp_path / "key.pem", tmp_path / "ca.pem"
    chain.write_bytes(b"".join(it.bytes() for it in certificate.cert_chain_pems))
    key.write_bytes(certificate.private_key_pem.bytes())
    ca_file.write_bytes(authority.cert_pem.bytes())
    server = ServerProcess(tmp_path, "--tls-cert", str(chain), "--tls-key", str(key))
    server.start()
    try:
        url = f"https://127.0.0.1:{server.port}"
        with Client(url, ca_file=ca_file) as client:
            client.cameras.create(id="yard")
            answers = list(client.stream_items("yard", [sample(1)]))
            assert [it.seq for it in answers] == [1]
        with (
            pytest.raises(ConnectionFailedError, match="CERTIFICATE_VERIFY_FAILED"),
            Client(url, retry=RetryPolicy(attempts=1)) as stranger,
        ):
            stranger.cameras.get("yard")
    finally:
        server.stop()


def test_the_asynchronous_client_has_the_same_methods(server: ServerProcess, recording: tuple[Path, Path]) -> None:
    async def scenario() -> None:
        async with AsyncClient(server.url) as client:
            await client.cameras.create(id="square", image_size=ImageSize(width_px=1280, height_px=720))
            imported = await client.samples.import_file("square", recording[0])
            assert imported.accepted == 240
            run = await client.training_runs.start("square", recipe="projective", epochs=20)
            assert (await client.training_runs.wait(run, poll_s=0.1)).model_version == 1
            samples = [it async for it in client.samples.list("square", page_size=150)]
            assert len(samples) == 240
            observations = [Observation(time=it.time, bounding_box=it.bounding_box) for it in samples]
            assert len(await client.fusions.fuse_batch("square", observations)) == 240
            with pytest.raises(NotFoundError):
                await client.cameras.get("yard")

    asyncio.run(scenario())


def test_the_asynchronous_client_trains_a_site(server: ServerProcess, site_recording: dict[str, Path]) -> None:
    with Client(server.url) as client:
        site_with_samples(client, site_recording)

    async def scenario() -> None:
        async with AsyncClient(server.url) as client:
            run = await client.site_training_runs.start("street")
            ended = await client.site_training_runs.wait(run, poll_s=0.1)
            assert [it async for it in client.site_training_runs.list("street")] == [ended]
            assert ended.report is not None
            assert [it.camera_id for it in ended.report.cameras] == ["c1", "c2"]
            with pytest.raises(ConflictError):
                await client.site_training_runs.cancel("street", run.id)

    asyncio.run(scenario())
