//! Does everything bad that can be given to a command end in one line and the right exit code, with nothing half
//! written?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, UdpSocket};
use std::process::{Child, Stdio};
use std::time::Duration;

use common::{Bench, assert_failed};
use isinglass_net::{Client, ClientOptions, Link};

const RENDER: &str = "--backend cpu --size 16x16 -o out.png";

#[test]
fn a_header_shows_a_file_outside_its_folder_only_if_asked() {
    let bench = Bench::new();
    bench.write("secret.raw", [9; 64]);
    std::fs::create_dir(bench.path("data")).unwrap();
    let header =
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\nencoding: raw\ndata file: ../secret.raw\n";
    bench.write("data/scan.nhdr", header);
    for command in ["info data/scan.nhdr", "serve data/scan.nhdr --listen 127.0.0.1:0"] {
        let words = ["data/scan.nhdr", "../secret.raw", "--foreign-files"];
        assert_failed(command, &bench.run(command), 1, &words);
    }
    // The control: allowed, it is read, and a note names it.
    for allowed in ["--foreign-files", "--foreign-files=on"] {
        let info = bench.ok(&format!("info data/scan.nhdr {allowed}"));
        assert!(info.contains("note: the voxels are in the file \"../secret.raw\""), "{info}");
    }
    assert_failed("off", &bench.run("info data/scan.nhdr --foreign-files=off"), 1, &["--foreign-files"]);
}

#[test]
fn bad_usage_is_code_2() {
    let bench = Bench::new();
    for (line, words) in [
        ("rendr", &["rendr", "--help"][..]),
        ("render", &["VOLUME"]),
        ("render builtin:cloud@8", &["--output"]),
        ("render builtin:cloud@8 -o out.png --size 0x5", &["0x5", "WxH"]),
        ("render builtin:cloud@8 -o out.png --size 99999x5", &["99999x5", "8192"]),
        ("render builtin:cloud@8 -o out.png --fov 200", &["200", "170"]),
        ("render builtin:cloud@8 -o out.png --orbit 1", &["AZ,EL"]),
        ("render builtin:cloud@8 -o out.png --clip-box 1,0,0,1,0,1", &["1,0,0,1,0,1", "below"]),
        ("render builtin:cloud@8 -o out.png --clip-plane 0,0,0,1", &["0,0,0,1", "not zero"]),
        ("reproject a.iglf -o out.png --fov 30 --orthographic", &["--fov"]),
        ("render builtin:cloud@8 -o out.png --orbit nan,0", &["nan"]),
        ("render builtin:cloud@8 -o out.png --backend cuda", &["cuda", "auto, gpu, cpu"]),
        ("render builtin:cloud@8 -o out.png --background red", &["red", "#20242c"]),
        ("render builtin:cloud@8 -o none/out.png", &["no folder none"]),
        ("render builtin:cloud@8 -o out.png --shading maybe", &["maybe", "on, off"]),
        ("render builtin:cloud@8 -o out.png --specular 1.5", &["1.5", "0 to 1"]),
        ("render builtin:cloud@8 -o out.png --shininess 0", &["1 to 128"]),
        ("render builtin:cloud@8 -o out.png --focus 2", &["--aperture", "--stereo"]),
        ("render builtin:cloud@8 -o out.png --anaglyph", &["--stereo"]),
        ("render builtin:cloud@8 -o out.png --samples 8", &["--shutter"]),
        ("reproject a.iglf -o out.png --stereo far", &["far", "radii"]),
        ("reproject a.iglf -o out.png --aperture -1", &["-1"]),
        ("reproject a.iglf -o out.png --aperture 0.1 --focus 0", &["0.001", "radii"]),
        ("reproject a.iglf -o out.png --shutter 40", &["AZ,EL"]),
        ("layers builtin:cloud@8 -o a.iglf --k 33", &["33", "1 to 32"]),
        ("layers builtin:cloud@8 -o a.iglf --turn 2", &["--turn", "--codec blocks"]),
        ("layers builtin:cloud@8 -o a.iglf --codec blocks --turn 11", &["--turn", "11", "at most 10"]),
        // Told before anything is read.
        ("layers nothing.nrrd -o a.iglf --turn 2", &["--turn", "--codec blocks"]),
        ("layers builtin:cloud@8 -o a.iglf --quality 20", &["--quality", "--codec blocks"]),
        ("layers builtin:cloud@8 -o a.iglf --bytes 900", &["--bytes", "--codec blocks"]),
        ("info a.raw --dims 1,2,0 --dtype uint8", &["1,2,0"]),
        ("info a.raw --dims 1,2,3", &["--dtype"]),
        ("info a.raw --dims 1,2,3 --dtype word", &["word", "uint8"]),
        ("info a.raw --dims 1,2,3 --dtype uint8 --spacing 1,-1,1", &["1,-1,1"]),
        ("info a.raw --region 5", &["5", "0:100,50:,:"]),
        ("info a.raw --region 5:5,:,:", &["5:5 is empty"]),
        ("demo --rtt fast", &["fast", "200ms"]),
        ("demo --rtt -5ms", &["-5"]),
        ("view nothing", &["no file 'nothing'", "a link", "host:/path"]),
        ("render builtin:cubus@16 -o a.jpg", &[".png", ".jpg"]),
        ("reproject a.iglf -o a.TIFF", &[".png", ".tiff"]),
        ("view isinglass://localhost:4433", &["token"]),
        ("serve builtin:cloud@8 --listen nowhere", &["nowhere"]),
        ("bench speed --k 0", &["1 to 32"]),
        ("bench speed --frame-size 0x4", &["0x4", "WxH"]),
        ("bench speed --angles 5,steep", &["steep", "degrees"]),
        ("bench latency --prediction maybe", &["maybe", "on, off"]),
        ("bench speed --repeats 0", &["1..=1000"]),
        ("bench latency --speed 1000", &["1000", "360"]),
        ("bench codecs", &["codecs"]),
    ] {
        bench.fails(line, 2, words);
    }
}

#[test]
fn bad_volumes_and_looks_are_code_1() {
    let bench = Bench::new();
    let header = |fields: &str| format!("NRRD0004\ntype: uint8\ndimension: 3\nencoding: raw\n{fields}\n\n");
    let attached =
        |fields: &str, num_bytes: usize| [header(fields).into_bytes(), vec![7; num_bytes]].concat();
    bench.write("short.nrrd", attached("sizes: 4 4 4", 63));
    bench.write("zero.nrrd", attached("sizes: 4 0 4", 64));
    bench.write("huge.nrrd", attached("sizes: 99999999 99999999 99999999", 64));
    bench.write("contradiction.nrrd", attached("sizes: 4 4 4 4", 64));
    bench.write("mistyped.nrrd", header("sizes: 4 four 4"));
    bench.write("twice.nrrd", attached("sizes: 4 4 4\nsizes: 4 4 4", 64));
    bench.write("endless.nrrd", "NRRD0004\ntype: uint8\n");
    bench.write("text.nrrd", "hello");
    bench.write("empty.nrrd", "");
    bench.write("detached.nhdr", header("sizes: 4 4 4\ndata file: missing.raw"));
    let nan = [1f32, f32::NAN, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0].map(f32::to_le_bytes).concat();
    bench.write("nan.raw", &nan);
    for (volume, words) in [
        ("missing.nrrd", &["missing.nrrd"][..]),
        (".", &["a folder"]),
        ("builtin:fog", &["fog", "builtin:cloud"]),
        ("builtin:cloud@1", &["cloud@1"]),
        ("builtin:cloud@99999", &["99999"]),
        ("short.nrrd", &["short.nrrd", "64 bytes", "found 63"]),
        ("zero.nrrd", &["zero.nrrd", "sizes"]),
        ("huge.nrrd", &["huge.nrrd"]),
        ("contradiction.nrrd", &["contradiction.nrrd", "sizes"]),
        ("mistyped.nrrd", &["mistyped.nrrd", "four"]),
        ("twice.nrrd", &["twice.nrrd", "twice"]),
        ("endless.nrrd", &["endless.nrrd"]),
        ("text.nrrd", &["text.nrrd", "expected an NRRD file"]),
        ("empty.nrrd", &["empty.nrrd", "an empty file"]),
        ("detached.nhdr", &["missing.raw"]),
        ("nan.raw --dims 2,2,2 --dtype float", &["nan.raw", "NaN"]),
        ("nan.raw --dims 2,2,2 --dtype double", &["nan.raw", "64 bytes", "found 32"]),
        ("nan.raw --dims 2048,2048,2048 --dtype double", &["nan.raw"]),
        ("nan.raw", &["nan.raw", "expected an NRRD file"]),
    ] {
        bench.fails(&format!("info {volume}"), 1, words);
        bench.fails(&format!("render {volume} {RENDER}"), 1, words);
        bench.fails(&format!("serve {volume} --listen 127.0.0.1:0 --backend cpu"), 1, words);
    }
    let point = |x: f32| format!("[[point]]\nx = {x}\ncolor = \"#ffffff\"\nopacity = 0.5\n");
    bench.write("order.toml", point(0.8) + &point(0.2));
    bench.write("range.toml", point(1.5));
    bench.write("none.toml", "name = \"none\"");
    bench.write("broken.toml", "[[point");
    for (tf, words) in [
        ("bones", &["bones", "industrial"][..]),
        ("order.toml", &["order.toml", "0.2", "ascending"]),
        ("range.toml", &["range.toml", "1.5"]),
        ("none.toml", &["none.toml", "0 control points"]),
        ("broken.toml", &["broken.toml", "line 1"]),
    ] {
        bench.fails(&format!("render builtin:cloud@8 --tf {tf} {RENDER}"), 1, words);
    }
    // The same command with nothing wrong: what fails above fails for its reason.
    bench.ok(&format!("render builtin:cloud@8 --tf ct {RENDER}"));
}

#[test]
fn bad_pictures_and_tables_are_code_1() {
    let bench = Bench::new();
    bench.ok(&format!("render builtin:cloud@8 {RENDER}"));
    bench.ok("render builtin:cloud@8 --size 8x16 --backend cpu -o narrow.png");
    bench.write("text.png", "no picture");
    let png = std::fs::read(bench.path("out.png")).unwrap();
    bench.write("cut.png", &png[..png.len() / 2]);
    for (other, words) in [
        ("narrow.png", &["narrow.png", "8x16", "16x16"][..]),
        ("text.png", &["text.png", "PNG"]),
        ("cut.png", &["cut.png"]),
        ("missing.png", &["missing.png"]),
        (".", &["."]),
    ] {
        bench.fails(&format!("compare out.png {other}"), 1, words);
    }
    for table in ["speed", "latency"] {
        bench.fails(&format!("bench {table} bonzai -o table.json"), 2, &["bonzai", "bonsai", "mouse_brain"]);
    }
    bench.fails("bench speed bonsai", 1, &["bonsai", "ISINGLASS_DATA"]);
    bench.fails("demo builtin:cloud@8 --headless --out out.png --backend cpu", 1, &["out.png", "folder"]);
    bench.fails("demo builtin:cloud@8 --headless --loss 1.5", 2, &["loss", "1.5"]);
    bench.fails("demo builtin:cloud@64 --headless --max-memory 1kB", 1, &["memory", "1000"]);
    bench.fails("reproject out.png -o b.png", 1, &["out.png", "PNG", "a layered frame"]);
    if cfg!(unix) {
        bench.fails("layers builtin:cloud@8 --backend cpu -o /dev/null", 1, &["/dev/null", "regular file"]);
        bench.ok("render builtin:cloud@8 --backend cpu --size 8x8 -o /dev/null");
        assert!(!std::fs::metadata("/dev/null").unwrap().is_file());
    }
    bench.fails("demo builtin:fog --headless --out new --backend cpu", 1, &["fog"]);
}

/// A scan that is written over is gone.
#[test]
fn nothing_that_is_read_is_written_over() {
    let bench = Bench::new();
    bench.ok("layers builtin:shells@16 --size 16x16 --backend cpu -o a.iglf");
    let scan =
        [b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 4 4\nencoding: raw\n\n".to_vec(), vec![7; 64]];
    bench.write("scan.nrrd", scan.concat());
    bench.write("state.toml", "");
    for (line, file) in [
        ("render scan.nrrd --size 8x8 -o scan.nrrd", "scan.nrrd"),
        ("layers scan.nrrd --size 8x8 -o ./scan.nrrd", "scan.nrrd"),
        ("layers scan.nrrd --size 8x8 --tf state.toml -o state.toml", "state.toml"),
        ("reproject a.iglf -o a.iglf", "a.iglf"),
        ("bench speed scan.nrrd -o scan.nrrd", "scan.nrrd"),
    ] {
        let before = std::fs::read(bench.path(file)).unwrap();
        bench.fails(line, 2, &[file, "two files"]);
        assert_eq!(std::fs::read(bench.path(file)).unwrap(), before, "{line}");
    }
    // The control: over what is not read.
    bench.ok("render scan.nrrd --size 8x8 --backend cpu -o a.iglf");
}

/// Cut and changed at many places: an error of one line or, where the change is harmless, a picture.
#[test]
fn a_damaged_frame_is_an_error_or_a_picture() {
    let bench = Bench::new();
    bench.ok("layers builtin:shells@16 --size 32x32 --backend cpu -o a.iglf");
    let good = std::fs::read(bench.path("a.iglf")).unwrap();
    let mut failures = 0;
    for i in 0..24 {
        let at = i * good.len() / 24;
        let mut mutated = good.clone();
        mutated[at] ^= 1 << (i % 8);
        for (name, bytes) in [("cut.iglf", &good[..at]), ("mutated.iglf", &mutated[..])] {
            bench.write(name, bytes);
            let line = format!("reproject {name} --orbit 10,0 -o b.png --backend cpu");
            let output = bench.run(&line);
            if output.status.code() != Some(0) {
                assert_failed(&line, &output, 1, &[name]);
                assert!(!bench.files().contains(&"b.png".into()), "{line}: wrote a picture and failed");
                failures += 1;
            } else {
                assert!(name != "cut.iglf", "a frame cut at {at} was accepted");
                std::fs::remove_file(bench.path("b.png")).unwrap();
            }
        }
    }
    // Every cut, and at least the changes in the magic number and headers.
    assert!(failures > 24, "{failures}");
    bench.fails("reproject out.png -o b.png", 1, &["out.png"]);
    bench.write("longer.iglf", [&good[..], b"more"].concat());
    bench.fails("reproject longer.iglf -o b.png", 1, &["longer.iglf", "end of the file"]);
}

#[test]
fn a_port_in_use_is_told() {
    let bench = Bench::new();
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let port = address.port().to_string();
    bench.fails(
        &format!("serve builtin:cloud@8 --backend cpu --listen {address}"),
        1,
        &[&port, "127.0.0.1", "in use"],
    );
}

/// Elsewhere there is always a display.
#[cfg(all(unix, not(target_os = "macos")))]
#[test]
fn without_a_display_the_viewer_says_so() {
    let bench = Bench::new();
    let link = link_to(9);
    bench.fails(&format!("view {link}"), 1, &["display", "doctor"]);
    // A link may come by standard input; what is none is told of.
    for (text, words) in [(&*link, &["display"][..]), ("hello", &["standard input", "not an isinglass link"])]
    {
        let mut child = bench.command("view -").stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        assert_failed(text, &child.wait_with_output().unwrap(), 1, words);
    }
    // What is wrong with a command is told first.
    for (line, words) in [
        (&*format!("view {link} --tf ct"), &["--tf", "give them to `serve`"][..]),
        ("view --mode mip", &["--tf", "found none"]),
        ("view builtin:cloud --tf nothing", &["preset", "nothing"]),
    ] {
        bench.fails(line, 1, words);
    }
    bench.fails("view builtin:cloud --mode mip --iso 3", 2, &["--iso", "expected --mode iso"]);
}

/// A link where something else belongs is told of without its secret.
#[test]
fn no_error_repeats_the_secret_of_a_link() {
    let bench = Bench::new();
    let link = link_to(9);
    for (line, status) in [
        (format!("serve {link}"), 1),
        (format!("render {link} -o a.png"), 1),
        (format!("layers cloud --k {link}"), 2),
        (format!("view builtin:cloud {link}"), 2),
    ] {
        let output = bench.command(&line).output().unwrap();
        assert_failed(&line, &output, status, &["token=…"]);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!error.contains("0a0a"), "{error}");
    }
}

/// Wrong token, wrong certificate, nobody there: one line each, and the server goes on serving.
#[test]
fn a_viewer_that_is_not_let_in_fails_and_the_server_goes_on() {
    let bench = Bench::new();
    let mut server = Serving::start(&bench);
    let display = FakeDisplay::new();
    let good = server.link.clone();
    let (head, cert) = good.split_once("&cert=").unwrap();
    let wrong_token = format!("{}{}&cert={cert}", &head[..head.len() - 4], flip(&head[head.len() - 4..]));
    let wrong_cert = format!("{}{}", &good[..good.len() - 4], flip(&good[good.len() - 4..]));
    let gone = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    for (link, word) in [(wrong_token, "token"), (wrong_cert, "certificate"), (link_to(gone), "127.0.0.1")] {
        let line = format!("view {link}");
        let output = bench.command(&line).env("DISPLAY", &display.name).output().unwrap();
        assert_failed(word, &output, 1, &[word]);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!error.contains("token="), "the secret is repeated: {error}");
    }
    let link: Link = good.parse().unwrap();
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    let welcome = client.wait_connected(Duration::from_secs(20)).unwrap();
    assert_eq!(welcome.volume.dims, [16; 3]);
    drop(client);
    server.interrupt();
}

/// A server as a child, ended at the end.
struct Serving {
    child: Child,
    link: String,
}

impl Serving {
    fn start(bench: &Bench) -> Self {
        let mut command = bench.command("serve builtin:shells@16 --backend cpu --listen 127.0.0.1:0");
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut link = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut link).unwrap();
        assert!(link.starts_with("isinglass://127.0.0.1:"), "{link}");
        Self { child, link: link.trim().to_owned() }
    }

    /// Ctrl-C ends it in order.
    fn interrupt(&mut self) {
        if cfg!(unix) {
            let kill =
                std::process::Command::new("kill").args(["-INT", &self.child.id().to_string()]).status();
            assert!(kill.unwrap().success());
            assert_eq!(self.child.wait().unwrap().code(), Some(0));
            let mut error = String::new();
            self.child.stderr.take().unwrap().read_to_string(&mut error).unwrap();
            assert!(error.contains("closing") && !error.contains("panicked"), "{error}");
        }
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Something that accepts connections where an X server would: enough to be taken for a display.
struct FakeDisplay {
    _listener: TcpListener,
    name: String,
}

impl FakeDisplay {
    fn new() -> Self {
        loop {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            if let Some(number) = listener.local_addr().unwrap().port().checked_sub(6000) {
                return Self { _listener: listener, name: format!("127.0.0.1:{number}") };
            }
        }
    }
}

/// A well-formed link to a port of this machine.
fn link_to(port: u16) -> String {
    format!("isinglass://127.0.0.1:{port}/#token={}&cert=sha256:{}", "0a".repeat(16), "0b".repeat(32))
}

/// Other hexadecimal digits.
fn flip(hex: &str) -> String {
    hex.chars().map(|c| if c == '0' { '1' } else { '0' }).collect()
}
