"""The page of `view`: its drawing and its server, without a browser."""

import http.client
import io
import json
import socket
import threading
import urllib.request
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from command_line import PANEL, scene
from PIL import Image

from lightfield_gs import encode, render
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.stereo import join_eyes, render_eyes
from lightfield_gs.panels.comfort import depth_report
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import panel_quilt
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.panels.stereo_screen import StereoScreen
from lightfield_gs.show.page import routes
from lightfield_gs.show.page.exports import exports
from lightfield_gs.show.page.routes import shown_routes
from lightfield_gs.show.page.server import Server
from lightfield_gs.show.page.stage import Controls, Stage, StagedScene, cut_out, orbited
from lightfield_gs.show.page.steering import steering_routes
from lightfield_gs.show.page.stereo_stage import StereoStage
from lightfield_gs.show.preview import to_integers

CELLS = replace(
    PANEL, subpixel_cells=tuple(((-0.3, y), (0.28, y), (0.0, -y)) for y in (0.25, -0.25, 0.1, -0.1)), cell_pattern=3
)


def stage(panel: Panel = PANEL) -> Stage:
    gaussians = scene()
    return Stage(StagedScene(gaussians, Rig.frame(gaussians, panel), "s.ply"), panel)


@contextmanager
def serving(routes, host="127.0.0.1"):
    server = Server(routes, host=host)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def get(server: Server, path: str, method: str = "GET", body: str | None = None, **headers):
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=30)
    connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body, answer


def test_orbit_goes_around_what_lies_in_the_panel():
    gaussians = scene()
    rig = Rig.frame(gaussians, PANEL)
    turned = orbited(rig, 30, 20)

    def centre(rig):
        return -rig.world_to_camera[:3, :3].T @ rig.world_to_camera[:3, 3]

    pivot = rig.world_to_camera[:3, :3].T @ ([0, 0, rig.zero_depth] - rig.world_to_camera[:3, 3])
    seen = turned.world_to_camera[:3, :3] @ pivot + turned.world_to_camera[:3, 3]
    np.testing.assert_allclose(seen, [0, 0, rig.zero_depth], atol=1e-9)
    right, down = rig.world_to_camera[0, :3], rig.world_to_camera[1, :3]
    gone = centre(turned) - centre(rig)
    assert gone @ right > 0 > gone @ down  # to the right, and up
    assert turned.world_to_camera[0, :3] @ down == pytest.approx(0, abs=1e-12)  # the horizon stays level


def test_eye_at_rest_is_what_simulate_sees_of_what_encode_draws():
    shown, controls = stage(), Controls(yaw_deg=10, depth_amount=0.5, zoom=1.2, eye=0.25)
    rig = controls.rig(shown.base, PANEL)
    native = encode(shown.gaussians, PANEL, rig).numpy()
    zone_mm = 2 * 600 * np.tan(np.radians(PANEL.cone_deg) / 2)
    seen = to_integers(simulate(native, PANEL, (0.25 * zone_mm, 0, 600)), 8)
    picture = shown.eye(controls, 64, still=True)
    np.testing.assert_array_equal(picture.pixels, seen)
    assert {"composite", "simulate"} <= picture.stages_ms.keys()


@pytest.mark.parametrize("inverted", [False, True])
def test_a_coarse_eye_is_the_view_at_its_side(inverted):
    panel = replace(PANEL, invert_views=inverted, width_px=480, height_px=300)
    shown = stage(panel)
    coarse = [shown.eye(Controls(eye=eye), 480, still=False).pixels.astype(float) for eye in (-0.45, 0.45)]
    still = [shown.eye(Controls(eye=eye), 480, still=True).pixels for eye in (-0.45, 0.45)]
    still = [np.asarray(Image.fromarray(image).resize((480, 300)), float) for image in still]
    same = sum(np.abs(a - b).mean() for a, b in zip(coarse, still))
    crossed = sum(np.abs(a - b).mean() for a, b in zip(coarse, still[::-1]))
    assert same < 0.7 * crossed


@pytest.mark.parametrize("panel", [PANEL, CELLS, replace(CELLS, cell_rows="top")], ids=["stripes", "cells", "top"])
def test_part_of_a_panel_is_drawn_as_on_the_whole(panel):
    shown = stage(panel)
    whole = shown.crop(Controls(), (0.6, 0.4), (40, 30), still=True).pixels
    part = shown.crop(Controls(), (0.6, 0.4), (40, 30), still=False).pixels
    assert whole.shape == part.shape
    assert np.abs(whole.astype(int) - part).max() <= 1
    left, top, width, height = shown._box((0.6, 0.4), (40, 30))
    small, _ = cut_out(panel, shown.base, left, top, width, height)
    expected = panel.view_map()[top : top + height, left : left + width]
    assert (small.view_map() == expected).mean() > 0.999  # but for sub-pixels on the border of two views


def test_frames_and_exports_over_the_wire(tmp_path):
    shown = stage()
    with serving(steering_routes(shown, exports(shown))) as server:
        state = json.loads(get(server, "/scene.json")[1])
        assert state["panel"]["width_px"] == PANEL.width_px and state["gaussians"] == 60
        controls = "zoom=1.25&eye=0.1&quality=high"
        status, body, answer = get(server, f"/frame?show=eye&still=1&width=64&{controls}")
        picture = np.asarray(Image.open(io.BytesIO(body)))
        expected = shown.eye(Controls(zoom=1.25, eye=0.1, quality="high"), 64, still=True).pixels
        assert status == 200 and "simulate;dur=" in answer.headers["Server-Timing"]
        np.testing.assert_array_equal(picture, expected)

        (tmp_path / "native.png").write_bytes(get(server, f"/export/native.png?{controls}")[1])
        (tmp_path / "rig.yaml").write_bytes(get(server, f"/export/rig.yaml?{controls}")[1])
        drawn = encode(shown.gaussians, PANEL, Rig.from_yaml(tmp_path / "rig.yaml"), quality="high").numpy()
        np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "native.png")), drawn)
        layout = panel_quilt(PANEL)
        name = f"quilt{layout.suffix}.png"
        (tmp_path / name).write_bytes(get(server, f"/export/{name}?{controls}")[1])
        left_most = np.asarray(Image.open(tmp_path / name))[layout.tile(0)]
        rig = Rig.from_yaml(tmp_path / "rig.yaml")
        view = render(shown.gaussians, rig.cameras(PANEL, [PANEL.views - 1])).image[0].numpy()
        assert np.abs(left_most / 255 - view).max() < 0.01
        assert get(server, "/rest", "POST", controls, X_Token=state["token"])[0] == 204
        panel_png = np.asarray(Image.open(io.BytesIO(get(server, "/panel.png")[1])))
        np.testing.assert_array_equal(panel_png, drawn)  # the panel's page follows what came to rest
        depth = json.loads(get(server, f"/depth.json?{controls}")[1])
        report = depth_report(shown.gaussians, PANEL, Rig.from_yaml(tmp_path / "rig.yaml"))
        assert depth == json.loads(json.dumps(report.to_dict()))
        answers = [get(server, f"/focus.json?x=0.5&y={y / 10}") for y in range(11)]
        assert {status for status, *_ in answers} == {200, 400}  # the scene has gaps
        for focus in (json.loads(body)["focus"] for status, body, _ in answers if status == 200):
            assert 0.3 < focus / shown.base.zero_depth < 3


@pytest.mark.parametrize(
    "path, status",
    [
        ("/nothing", 404),
        ("/view.py", 404),
        ("/../server.py", 404),
        ("/%2e%2e/%2e%2e/etc/passwd", 404),
        ("/files/view.html", 404),
        ("/frame", 400),
        ("/frame?show=eye&width=1e9", 400),
        ("/frame?show=eye&width=nan", 400),
        ("/frame?show=other&width=64", 400),
        ("/frame?show=eye&width=64&zoom=x", 400),
        ("/frame?show=eye&width=64&focus=-1", 400),
        ("/frame?show=eye&width=64&quality=best", 400),
        ("/frame?show=native&width=64&height=64&x=7&y=0", 400),
        ("/frame?" + "a=1&" * 100, 400),
        ("/frame?" + "a" * 5000, 414),
        ("/panel.json", 400),
        ("/export/other.png", 404),
    ],
)
def test_bad_requests_are_refused(path, status):
    shown = stage()
    with serving(steering_routes(shown, exports(shown))) as server:
        assert get(server, path)[0] == status
        assert get(server, "/view.js")[0] == 200  # and it goes on


def test_odd_connections_end_nothing(capfd):
    with serving(shown_routes(PANEL, np.zeros((60, 96, 3), np.uint8))) as server:
        for words in (
            b"",
            b"\xff\x00 nonsense\r\n\r\n",
            b"GET\r\n\r\n",
            b"GET /panel HTTP/1.1\r\nHost: [\r\n\r\n",
            b"GET /pan",
        ):
            with socket.create_connection(server.server_address, timeout=5) as connection:
                connection.sendall(words)
        assert get(server, "/panel", "POST")[0] == 405
        assert get(server, "/panel", "PUT")[0] == 501
        assert get(server, "/panel", "HEAD")[1] == b""
        assert get(server, "/panel", Host="elsewhere.example")[0] == 403  # a name that was made to lead here
        assert get(server, "/panel")[0] == 200
    assert "Traceback" not in capfd.readouterr().err


FOREIGN = [
    {"Sec_Fetch_Site": "cross-site"},
    {"Sec_Fetch_Site": "same-site"},  # another port of this machine
    {"Origin": "http://elsewhere.example"},
    {"Origin": "null"},
    {"Referer": "http://elsewhere.example/"},  # browsers that send neither of these, as over plain http to a LAN
]


@pytest.mark.parametrize("headers", FOREIGN, ids=lambda headers: "-".join(headers.values()))
def test_pages_from_elsewhere_get_nothing_and_change_nothing(headers):
    shown = stage()
    with serving(steering_routes(shown, exports(shown))) as server:
        token = json.loads(get(server, "/scene.json")[1])["token"]
        for path in ("/", "/scene.json", "/panel.png", "/frame?show=eye&still=1&width=64&yaw_deg=120"):
            assert get(server, path, **headers)[0] == 403
        assert get(server, "/rest", "POST", "yaw_deg=120", X_Token=token, **headers)[0] == 403
        assert shown.version == 0


def test_only_a_post_with_the_token_changes_what_the_panel_shows():
    shown = stage()
    with serving(steering_routes(shown, exports(shown))) as server:
        token = json.loads(get(server, "/scene.json", Sec_Fetch_Site="same-origin")[1])["token"]
        turn, own = "yaw_deg=120", {"Sec_Fetch_Site": "same-origin", "Origin": server.url}
        assert get(server, f"/frame?show=eye&still=1&width=64&{turn}", Sec_Fetch_Site="none")[0] == 200
        assert get(server, "/panel", Referer=server.url + "/")[0] == 200
        assert get(server, f"/rest?{turn}", X_Token=token)[0] == 405
        assert get(server, "/rest", "POST", turn)[0] == 403
        assert get(server, "/rest", "POST", turn, X_Token=token[:-1])[0] == 403
        assert get(server, "/rest", "POST", "a" * 5000, X_Token=token)[0] == 400
        assert json.loads(get(server, "/panel.json?after=-1")[1])["version"] == 0
        assert get(server, "/rest", "POST", turn, X_Token=token, **own)[0] == 204
        assert json.loads(get(server, "/panel.json?after=-1")[1])["version"] == 1
        # What a refused request holds is not taken for the next one
        smuggled = f"POST /rest HTTP/1.1\r\nHost: localhost\r\nX-Token: {token}\r\nContent-Length: 9\r\n\r\nyaw_deg=1"
        assert get(server, "/panel", "POST", smuggled)[2].headers["Connection"] == "close"
        assert shown.version == 1


def test_no_answer_may_be_framed_or_read_elsewhere():
    with serving(shown_routes(PANEL, np.zeros((60, 96, 3), np.uint8))) as server:
        for path, method in (("/panel", "GET"), ("/panel.png", "HEAD"), ("/no", "GET"), ("/panel", "BREW")):
            headers = get(server, path, method)[2].headers
            assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
            assert headers["Cross-Origin-Resource-Policy"] == "same-origin"


@contextmanager
def slow_readers(server: Server, path: str, count: int):
    """Clients that ask and read what comes first, and no more: the first bytes of each."""
    with ExitStack() as opened:
        sockets = [
            opened.enter_context(socket.create_connection(server.server_address, timeout=5)) for _ in range(count)
        ]
        for each in sockets:
            each.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        yield [each.recv(12) for each in sockets]


def test_slow_readers_of_the_panel_share_one_packed_picture(monkeypatch):
    packed = []
    monkeypatch.setattr(routes, "stored_png", lambda _: packed.append(bytes(16 << 20)) or packed[-1])
    with serving(shown_routes(PANEL, np.zeros((60, 96, 3), np.uint8))) as server:
        with slow_readers(server, "/panel.png", 12) as begun:
            assert begun == [b"HTTP/1.1 200"] * 12 and len(packed) == 1
            assert server.request_queue_size == 128


def test_slow_readers_of_files_are_few_at_a_time(monkeypatch):
    monkeypatch.setattr("lightfield_gs.show.page.server._WAIT_S", 0.2)
    shown, made = stage(), []

    def export(controls, path):
        made.append(path)
        path.write_bytes(bytes(16 << 20))

    with serving(steering_routes(shown, {"native.png": export})) as server:
        with slow_readers(server, "/export/native.png", 12) as begun:
            assert sorted(begun) == [b"HTTP/1.1 200"] * 4 + [b"HTTP/1.1 503"] * 8 and len(made) == 4
            status, _, answer = get(server, "/export/native.png")
            assert status == 503 and int(answer.headers["Retry-After"]) > 0
            assert get(server, "/frame?show=eye&width=64")[0] == 200  # what moves has places of its own
        for _ in range(50):
            if get(server, "/export/native.png")[0] == 200:
                break
        else:
            raise AssertionError("the places of readers that went away stay taken")


def hosted(host: str):
    return serving(shown_routes(PANEL, np.zeros((60, 96, 3), np.uint8)), host)


@pytest.mark.parametrize("host", ["::1", "[::1]"])
def test_a_page_on_an_address_of_ipv6(host):
    if not socket.has_ipv6:
        pytest.skip("no IPv6 here")
    with hosted(host) as server:
        assert server.url == f"http://[::1]:{server.server_address[1]}" and server.is_local
        assert urllib.request.build_opener(urllib.request.ProxyHandler({})).open(f"{server.url}/panel").status == 200
        assert get(server, "/panel", Host="elsewhere.example")[0] == 403


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_page_for_the_network_has_addresses_and_names_and_no_others(host, monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "Box.lab.example")
    monkeypatch.setattr("lightfield_gs.show.page.server._addresses", lambda families: ["192.0.2.7", "2001:db8::7"])
    with hosted(host) as server:
        port = server.server_address[1]
        assert server.url in (f"http://127.0.0.1:{port}", f"http://[::1]:{port}") and not server.is_local
        assert server.other_urls == [f"http://192.0.2.7:{port}", f"http://[2001:db8::7]:{port}"]
        for name in ("localhost", "192.0.2.7", "[2001:db8::7]", "box", "BOX.lab.example", "box.local"):
            assert get(server, "/panel", Host=f"{name}:{port}")[0] == 200, name
        for name in ("elsewhere.example", "192.0.2.7.elsewhere.example", "lab.example", ""):
            assert get(server, "/panel", Host=name)[0] == 403, name


def test_a_name_given_as_host_is_one_of_the_page():
    with hosted("localhost") as server:
        assert server.is_local and get(server, "/panel", Host="localhost")[0] == 200
        assert get(server, "/panel", Host="localhost.")[0] == 200 and not server.is_name_of_itself
    with hosted("localhost.") as server:
        assert get(server, "/panel", Host="localhost")[0] == 200
    with pytest.raises(InputError, match="another host="):
        Server({}, host="no.such.name.invalid")
    with pytest.raises(InputError, match="no address of this machine.*another host="):
        Server({}, host="192.0.2.1")
    with pytest.raises(InputError, match="host=: expected an address"):
        Server({}, host="a..b")


def test_a_name_that_leads_a_machine_to_itself_is_known(monkeypatch):
    """Many a system has its own name as 127.0.0.1, so that others do not reach what is served there."""
    monkeypatch.setattr(socket, "gethostname", lambda: "box")
    monkeypatch.setattr(
        "lightfield_gs.show.page.server._resolved", lambda host, port: (socket.AF_INET, ("127.0.0.1", 0))
    )
    with hosted("Box") as server:
        assert server.is_name_of_itself and get(server, "/panel", Host="box")[0] == 200


def test_a_port_that_is_taken_is_a_complaint():
    with serving({}) as server, pytest.raises(InputError, match="give another port="):
        Server({}, server.server_address[1])


def test_a_screen_of_two_eyes_gets_both_pictures(tmp_path):
    """What `view --stereo` shows and saves is what `encode --stereo` draws, and moves as the controls do."""
    gaussians, screen = scene(), StereoScreen(96, 54).panel()
    shown = StereoStage(StagedScene(gaussians, Rig.frame(gaussians, screen), "s.ply"), screen, "half-sbs")
    with serving(steering_routes(shown, exports(shown))) as server:
        state = json.loads(get(server, "/panel.json?after=-1")[1])
        assert state["fills"] and json.loads(get(server, "/drawing.json")[1]) is None
        body = get(server, "/export/eyes_half_2x1.png?zoom=1.2")[1]
        rig = Controls(zoom=1.2).rig(shown.base, screen)
        drawn = join_eyes(render_eyes(gaussians, screen, rig), "half-sbs").numpy()
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(body))), drawn)
        eye = get(server, "/frame?show=eye&still=0&width=96&eye=-0.25")[1]
        left = np.asarray(Image.open(io.BytesIO(eye))).astype(int)
        apart = [np.abs(left - each.numpy()).mean() for each in render_eyes(gaussians, screen, shown.base)]
        assert apart[0] < 0.6 * apart[1]
        for query in ("show=native&still=1&width=40&height=30&x=1&y=0.5", "show=sheet&still=0&width=64"):
            assert get(server, f"/frame?{query}")[0] == 200
