//! Where the pinned library comes from, and what is checked before it is used. Included by the build script; a module of
//! the crate only under test.

use super::cache::cache_dir;
use sha2::{Digest, Sha256};
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};
use std::{env, fs};

/// Environment variables that decide where the library comes from.
pub(crate) const VARIABLES: [&str; 7] = [
    "MUJOCO_DYNAMIC_LINK_DIR",
    "MUJOCO_STATIC_LINK_DIR",
    "MUJOCO_WHEEL",
    "E2H_MUJOCO_CACHE",
    "XDG_CACHE_HOME",
    "CARGO_NET_OFFLINE",
    "DOCS_RS",
];

const VERSION: &str = "3.17.0";
/// A library is 10 to 20 MB, a wheel and an archive under 40; more than this is not MuJoCo.
const MAX_BYTES: u64 = 200 << 20;

/// The library of one platform and its pinned sums.
pub(crate) struct Library {
    /// Name of the library file.
    pub(crate) file: &'static str,
    /// SHA-256 of the library itself. Unknown for aarch64: there the wheel's own sum is what is checked.
    pub(crate) sha256: Option<&'static str>,
    /// Wheel that holds the library, and that wheel's SHA-256.
    pub(crate) wheel: &'static str,
    /// SHA-256 of the wheel.
    pub(crate) wheel_sha256: &'static str,
    /// Platform tag for `pip download`.
    pub(crate) platform: &'static str,
    /// Official archive, offered where the library's own sum is known.
    pub(crate) archive: Option<&'static str>,
}

impl Library {
    /// The pinned library for a target, named as cargo names it (`linux`, `x86_64`).
    pub(crate) fn pinned(os: &str, arch: &str) -> Result<Self, String> {
        match (os, arch) {
            ("linux", "x86_64") => Ok(Self {
                file: "libmujoco.so.3.17.0",
                sha256: Some("23496b023ee80fb61ab71167e94bc649f9941710fde96b18bb8204fb332523ad"),
                wheel: "mujoco-3.17.0-cp312-cp312-manylinux_2_27_x86_64.manylinux_2_28_x86_64.whl",
                wheel_sha256: "42371356efe53a5f5f73ed03fcb967bdf04048017f80e2fca01e71a360e42da2",
                platform: "manylinux_2_28_x86_64",
                archive: Some(
                    "https://github.com/google-deepmind/mujoco/releases/download/3.17.0/mujoco-3.17.0-linux-x86_64.tar.gz",
                ),
            }),
            ("linux", "aarch64") => Ok(Self {
                file: "libmujoco.so.3.17.0",
                sha256: None,
                wheel: "mujoco-3.17.0-cp312-cp312-manylinux_2_27_aarch64.manylinux_2_28_aarch64.whl",
                wheel_sha256: "525e09a00ecd964f06582773d9eeb03bb0e5a1675edf296a6868024759b3b235",
                platform: "manylinux_2_28_aarch64",
                archive: None,
            }),
            _ => Err(format!(
                "no MuJoCo {VERSION} library is pinned for {os}/{arch} (only linux/x86_64 and linux/aarch64).\n\
                 Set MUJOCO_DYNAMIC_LINK_DIR to the lib/ directory of a MuJoCo {VERSION} release for it."
            )),
        }
    }

    /// Refuses bytes that are not the pinned library (where its sum is known).
    fn check(&self, bytes: Vec<u8>) -> Result<Vec<u8>, String> {
        match self.sha256 {
            Some(expected) => check(bytes, self.file, expected),
            None => Ok(bytes),
        }
    }

    /// The library inside a wheel, checked.
    fn unpack_wheel(&self, wheel: Vec<u8>) -> Result<Vec<u8>, String> {
        // Where the library's own sum is pinned, any wheel that holds it will do.
        let wheel = if self.sha256.is_some() { wheel } else { check(wheel, self.wheel, self.wheel_sha256)? };
        let mut zip = zip::ZipArchive::new(Cursor::new(wheel)).map_err(|e| format!("not a wheel: {e}"))?;
        let member = format!("mujoco/{}", self.file);
        let file = zip.by_name(&member).map_err(|e| format!("{member} in the wheel: {e}"))?;
        self.check(read_all(file)?)
    }

    /// The library inside the release archive (`.tar.gz`), checked.
    fn unpack_archive(&self, archive: &[u8]) -> Result<Vec<u8>, String> {
        let member = format!("lib/{}", self.file);
        let mut tar = tar::Archive::new(flate2::read::GzDecoder::new(archive));
        for entry in tar.entries().map_err(|e| format!("not an archive: {e}"))? {
            let entry = entry.map_err(|e| format!("not an archive: {e}"))?;
            if entry.header().entry_type().is_file() && entry.path().is_ok_and(|p| p.ends_with(&member)) {
                return self.check(read_all(entry)?);
            }
        }
        Err(format!("no {member} in the archive"))
    }
}

/// What the user's environment says.
pub(crate) struct Settings {
    /// Per-user cache; none when no home directory is known.
    pub(crate) cache: Option<PathBuf>,
    /// Wheel file named by `MUJOCO_WHEEL`.
    pub(crate) wheel: Option<PathBuf>,
    /// True when cargo must not use the network.
    pub(crate) offline: bool,
    /// Scratch directory for downloads.
    pub(crate) work: PathBuf,
}

impl Settings {
    /// Reads the environment.
    pub(crate) fn from_environment(work: PathBuf) -> Self {
        Self {
            cache: cache_dir(),
            wheel: env::var_os("MUJOCO_WHEEL").map(PathBuf::from),
            offline: env::var("CARGO_NET_OFFLINE").is_ok_and(|v| v == "true" || v == "1"),
            work,
        }
    }
}

/// A place to get the library from: its name in messages, and how to get it.
type Source<'a> = (String, Box<dyn Fn() -> Result<Vec<u8>, String> + 'a>);

/// The library's bytes, checked, from the first source that has them; kept in the cache for the next build.
pub(crate) fn obtain(library: &Library, settings: &Settings) -> Result<Vec<u8>, String> {
    let cached = settings.cache.as_ref().map(|dir| {
        let sum = library.sha256.unwrap_or(library.wheel_sha256);
        dir.join(format!("mujoco-{VERSION}-{}", &sum[..12])).join(library.file)
    });
    let mut sources: Vec<Source<'_>> = vec![];
    if let Some(path) = &cached {
        sources.push((format!("cache {}", path.display()), Box::new(|| read_cached(library, path))));
    }
    if let Some(path) = &settings.wheel {
        let name = format!("MUJOCO_WHEEL={}", path.display());
        sources.push((name, Box::new(|| library.unpack_wheel(read_file(path)?))));
    }
    if settings.offline {
        sources.push(("network".into(), Box::new(|| Err("not used, CARGO_NET_OFFLINE is set".into()))));
    } else {
        let pip = || library.unpack_wheel(pip_download(library, &settings.work)?);
        sources.push((format!("pip download mujoco=={VERSION}"), Box::new(pip)));
        if let Some(url) = library.archive {
            sources.push((url.into(), Box::new(|| library.unpack_archive(&download(url)?))));
        }
    }
    let bytes = first(&sources).map_err(|tried| failure(library, &tried))?;
    if let Some(path) = &cached {
        // Best effort: without a cache the next clean build fetches again.
        let _ = write_cached(path, &bytes);
    }
    Ok(bytes)
}

/// Sees to it that `path`, in the build's output folder, is the library: a file that is there is verified like the cached
/// one, and replaced where it is damaged.
///
/// The file gets a modification time of its own, older than any build, so that cargo asks again when it changes.
pub(crate) fn install(library: &Library, settings: &Settings, path: &Path) -> Result<(), String> {
    if read_cached(library, path).is_err() {
        write_cached(path, &obtain(library, settings)?)?;
    }
    let dated = fs::File::options().write(true).open(path).and_then(|f| f.set_modified(DATED));
    dated.map_err(|e| format!("{}: {e}", path.display()))
}

/// Modification time of an installed library.
const DATED: std::time::SystemTime = std::time::UNIX_EPOCH;

/// What the first good source gives, else one line a source with what was wrong.
fn first(sources: &[Source<'_>]) -> Result<Vec<u8>, Vec<String>> {
    let mut tried = vec![];
    for (name, get) in sources {
        match get() {
            Ok(bytes) => return Ok(bytes),
            Err(why) => tried.push(format!("{name}: {why}")),
        }
    }
    Err(tried)
}

/// The one message of a build that found nothing.
fn failure(library: &Library, tried: &[String]) -> String {
    let list: String = tried.iter().map(|t| format!("  - {t}\n")).collect();
    let archive = library.archive.map_or_else(String::new, |url| format!(" (for example {url})"));
    format!(
        "could not get the MuJoCo {VERSION} library. Tried:\n{list}Ways out, any one of them:\n\
         \u{20} - let this build reach the network: it runs `python3 -m pip download` with your pip settings (index, \
         mirror, proxy);\n\
         \u{20} - set MUJOCO_WHEEL to a downloaded {};\n\
         \u{20} - set MUJOCO_DYNAMIC_LINK_DIR to the absolute path of the lib/ directory of an unpacked MuJoCo {VERSION} \
         release{archive}.",
        library.wheel
    )
}

/// Writes a file as a whole or not at all.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), String> {
    let part = path.with_extension(format!("part{}", std::process::id()));
    fs::write(&part, bytes)
        .and_then(|()| fs::rename(&part, path))
        .map_err(|e| format!("{}: {e}", path.display()))
}

fn write_cached(path: &Path, bytes: &[u8]) -> Result<(), String> {
    let dir = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(dir).map_err(|e| format!("{}: {e}", dir.display()))?;
    write_whole(path, bytes)?;
    write_whole(&path.with_extension("sha256"), sha256(bytes).as_bytes())
}

fn read_cached(library: &Library, path: &Path) -> Result<Vec<u8>, String> {
    let bytes = read_file(path)?;
    // Where no sum is pinned, the one noted when the checked wheel was unpacked finds a damaged file.
    match library.sha256 {
        Some(_) => library.check(bytes),
        None => {
            let noted = fs::read_to_string(path.with_extension("sha256")).map_err(|e| e.to_string())?;
            check(bytes, library.file, noted.trim())
        }
    }
}

fn pip_download(library: &Library, work: &Path) -> Result<Vec<u8>, String> {
    for python in ["python3", "python"] {
        let run = std::process::Command::new(python)
            .args(["-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"])
            .args(["--implementation", "cp", "--python-version", "312", "--platform", library.platform, "-d"])
            .arg(work)
            .arg(format!("mujoco=={VERSION}"))
            .output();
        match run {
            Ok(done) if done.status.success() => return read_file(&work.join(library.wheel)),
            Ok(done) => {
                let text = String::from_utf8_lossy(&done.stderr);
                let last = text.lines().rev().find(|l| !l.trim().is_empty());
                return Err(last.unwrap_or("failed without a message").trim().to_owned());
            }
            Err(_) => {} // no such program: try the next name
        }
    }
    Err("no python3 or python found".into())
}

fn download(url: &str) -> Result<Vec<u8>, String> {
    use ureq::tls::{RootCerts, TlsConfig};
    // The platform's own certificates, so that a company proxy works as it does for other programs.
    let tls = TlsConfig::builder().root_certs(RootCerts::PlatformVerifier).build();
    let agent: ureq::Agent = ureq::Agent::config_builder()
        .tls_config(tls)
        .timeout_connect(Some(std::time::Duration::from_secs(20)))
        .timeout_global(Some(std::time::Duration::from_secs(600)))
        .build()
        .into();
    let mut reply = agent.get(url).call().map_err(|e| e.to_string())?;
    reply.body_mut().with_config().limit(MAX_BYTES).read_to_vec().map_err(|e| e.to_string())
}

fn read_file(path: &Path) -> Result<Vec<u8>, String> {
    fs::read(path).map_err(|e| e.to_string())
}

fn read_all(reader: impl Read) -> Result<Vec<u8>, String> {
    let mut bytes = vec![];
    reader.take(MAX_BYTES).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
    Ok(bytes)
}

fn check(bytes: Vec<u8>, what: &str, expected: &str) -> Result<Vec<u8>, String> {
    let found = sha256(&bytes);
    if found == expected {
        Ok(bytes)
    } else {
        Err(format!("SHA-256 of {what}: expected {expected}, got {found}"))
    }
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    /// A stand-in library with the sum of `bytes`.
    fn library(bytes: &[u8]) -> Library {
        let sum: &'static str = Box::leak(sha256(bytes).into_boxed_str());
        Library { sha256: Some(sum), archive: None, ..Library::pinned("linux", "x86_64").unwrap() }
    }

    fn wheel(content: &[u8]) -> Vec<u8> {
        let mut zip = zip::ZipWriter::new(Cursor::new(vec![]));
        zip.start_file("mujoco/libmujoco.so.3.17.0", zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(content).unwrap();
        zip.finish().unwrap().into_inner()
    }

    fn settings(dir: &Path, wheel: Option<PathBuf>) -> Settings {
        Settings { cache: Some(dir.join("cache")), wheel, offline: true, work: dir.join("work") }
    }

    #[test]
    fn a_wheel_is_unpacked_once_and_then_comes_from_the_cache() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.whl");
        fs::write(&path, wheel(b"library")).unwrap();
        let library = library(b"library");
        let from_wheel = obtain(&library, &settings(dir.path(), Some(path))).unwrap();
        let from_cache = obtain(&library, &settings(dir.path(), None)).unwrap();
        assert_eq!((from_wheel.as_slice(), from_cache.as_slice()), (&b"library"[..], &b"library"[..]));
    }

    #[test]
    fn another_library_is_refused_and_never_cached() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.whl");
        fs::write(&path, wheel(b"something else")).unwrap();
        let message = obtain(&library(b"library"), &settings(dir.path(), Some(path))).unwrap_err();
        assert!(message.contains(&sha256(b"library")) && message.contains(&sha256(b"something else")));
        assert!(!dir.path().join("cache").exists());
    }

    #[test]
    fn a_damaged_cache_is_refused() {
        for sum in [Some(()), None] {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("libmujoco.so.3.17.0");
            write_cached(&path, b"library").unwrap();
            let library = Library { sha256: sum.and(library(b"library").sha256), ..library(b"library") };
            assert!(read_cached(&library, &path).is_ok());
            fs::write(&path, b"libr").unwrap();
            assert!(read_cached(&library, &path).unwrap_err().contains("expected"));
        }
    }

    #[test]
    fn a_damaged_library_in_the_output_folder_is_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let (source, path) = (dir.path().join("w.whl"), dir.path().join("out/libmujoco.so.3.17.0"));
        fs::write(&source, wheel(b"library")).unwrap();
        let library = library(b"library");
        let with = settings(dir.path(), Some(source));
        install(&library, &with, &path).unwrap();
        let dated = |path: &Path| fs::metadata(path).unwrap().modified().unwrap();
        assert_eq!((fs::read(&path).unwrap().as_slice(), dated(&path)), (&b"library"[..], DATED));
        // Cut off, or with a flipped bit: never kept, whether it can be had again or not.
        for damaged in [&b"libr"[..], b"librarz", b""] {
            fs::write(&path, damaged).unwrap();
            assert_ne!(dated(&path), DATED);
            let nowhere = Settings { cache: None, wheel: None, ..settings(dir.path(), None) };
            let message = install(&library, &nowhere, &path).unwrap_err();
            assert!(message.contains("could not get"), "{message}");
            install(&library, &with, &path).unwrap();
            assert_eq!((fs::read(&path).unwrap().as_slice(), dated(&path)), (&b"library"[..], DATED));
        }
    }

    #[test]
    fn without_a_pinned_library_the_wheel_itself_is_checked() {
        let library = Library::pinned("linux", "aarch64").unwrap();
        assert!(library.archive.is_none());
        assert!(library.unpack_wheel(wheel(b"library")).unwrap_err().contains(library.wheel_sha256));
    }

    #[test]
    fn the_archive_is_searched_for_the_library() {
        let mut tar = tar::Builder::new(flate2::write::GzEncoder::new(vec![], flate2::Compression::fast()));
        let mut header = tar::Header::new_gnu();
        header.set_size(7);
        header.set_mode(0o644);
        header.set_cksum();
        tar.append_data(&mut header, "mujoco-3.17.0/lib/libmujoco.so.3.17.0", &b"library"[..]).unwrap();
        let archive = tar.into_inner().unwrap().finish().unwrap();
        assert_eq!(library(b"library").unpack_archive(&archive).unwrap(), b"library");
        assert!(library(b"another").unpack_archive(&archive).unwrap_err().contains("expected"));
        assert!(library(b"library").unpack_archive(b"no archive").is_err());
    }

    #[test]
    fn the_message_lists_every_source_and_every_way_out() {
        let dir = tempfile::tempdir().unwrap();
        let mut settings = settings(dir.path(), Some(dir.path().join("absent.whl")));
        let library = Library::pinned("linux", "x86_64").unwrap();
        let message = obtain(&library, &settings).unwrap_err();
        for part in [
            "cache ",
            "absent.whl",
            "CARGO_NET_OFFLINE",
            "pip download",
            "MUJOCO_WHEEL",
            "MUJOCO_DYNAMIC_LINK_DIR",
        ] {
            assert!(message.contains(part), "{part} in {message}");
        }
        settings.wheel = None;
        assert!(!obtain(&library, &settings).unwrap_err().contains("absent.whl"));
    }

    #[test]
    fn another_platform_is_told_what_to_do() {
        let message = Library::pinned("macos", "aarch64").err().unwrap();
        assert!(message.contains("macos/aarch64") && message.contains("MUJOCO_DYNAMIC_LINK_DIR"));
    }
}
