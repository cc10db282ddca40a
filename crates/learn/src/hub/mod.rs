//! Checkpoints on the Hugging Face hub: fetched with `hf://OWNER/NAME`, published with a model card.
//!
//! The client is an optional feature, `hub`. Without it an `hf://` address is refused with the way to build with it; folders work
//! as ever.

mod card;
#[cfg(feature = "hub")]
mod client;

use crate::{Error, Result};
use std::path::{Path, PathBuf};

pub use card::{command, model_card};

/// How an address on the hub begins.
pub const SCHEME: &str = "hf://";
/// The branch that is meant when none is named.
pub const MAIN: &str = "main";
/// The problem that a build without the client reports.
#[cfg(not(feature = "hub"))]
const WITHOUT: &str = "this build has no hub client; build with `--features hub`";

/// A repository on the hub, and a revision of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// Who owns it.
    pub owner: String,
    /// What it is called.
    pub name: String,
    /// Branch, tag or commit; the main branch where none is named.
    pub revision: Option<String>,
}

impl std::str::FromStr for Address {
    type Err = Error;

    /// `OWNER/NAME` or `OWNER/NAME@revision`, with or without `hf://` before it.
    fn from_str(text: &str) -> Result<Self> {
        let bad = || Error::Hub {
            address: text.to_owned(),
            problem: "expected hf://OWNER/NAME or hf://OWNER/NAME@revision".to_owned(),
        };
        let plain = text.strip_prefix(SCHEME).unwrap_or(text);
        let (repository, revision) = match plain.split_once('@') {
            Some((repository, revision)) => (repository, Some(revision)),
            None => (plain, None),
        };
        let (owner, name) = repository.split_once('/').ok_or_else(bad)?;
        let word = |w: &str| {
            let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
            !w.is_empty() && w.chars().all(plain) && !w.contains("..") && !w.starts_with(['.', '-'])
        };
        let reference = |r: &str| {
            let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.' | '/');
            !r.is_empty() && r.chars().all(plain) && !r.contains("..") && !r.starts_with(['.', '-', '/'])
        };
        if !word(owner) || !word(name) || !revision.is_none_or(reference) {
            return Err(bad());
        }
        Ok(Self { owner: owner.to_owned(), name: name.to_owned(), revision: revision.map(str::to_owned) })
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{SCHEME}{}/{}", self.owner, self.name)?;
        self.revision.as_ref().map_or(Ok(()), |r| write!(f, "@{r}"))
    }
}

/// Where the hub is and how it is spoken to.
#[derive(Clone, PartialEq, Eq)]
pub struct Settings {
    /// Address of the hub.
    pub endpoint: String,
    /// Who is asking; none for what is public.
    pub token: Option<String>,
    /// Where fetched files are kept, laid out as by every client of the hub.
    pub cache: PathBuf,
    /// Nothing is asked of the network: only what is in the cache can be had.
    pub offline: bool,
}

impl std::fmt::Debug for Settings {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let token = if self.token.is_some() { "set" } else { "none" };
        f.debug_struct("Settings")
            .field("endpoint", &self.endpoint)
            .field("token", &token)
            .field("cache", &self.cache)
            .field("offline", &self.offline)
            .finish()
    }
}

impl Settings {
    /// What the environment says, by the names that all clients of the hub know: `HF_ENDPOINT`, `HF_TOKEN`, `HF_TOKEN_PATH`,
    /// `HF_HUB_DISABLE_IMPLICIT_TOKEN`, `HF_HUB_CACHE`, `HUGGINGFACE_HUB_CACHE`, `HF_HOME`, `XDG_CACHE_HOME`, `HF_HUB_OFFLINE`.
    #[must_use]
    pub fn from_env() -> Self {
        Self::from(|name| std::env::var(name).ok())
    }

    fn from(variable: impl Fn(&str) -> Option<String>) -> Self {
        let get = |name: &str| variable(name).map(|v| v.trim().to_owned()).filter(|v| !v.is_empty());
        let on = |name: &str| {
            get(name).is_some_and(|v| ["1", "ON", "YES", "TRUE"].contains(&v.to_uppercase().as_str()))
        };
        let home = get("HF_HOME").map(PathBuf::from).unwrap_or_else(|| {
            let cache = get("XDG_CACHE_HOME").map(PathBuf::from);
            let cache = cache.or_else(|| Some(PathBuf::from(get("HOME")?).join(".cache")));
            cache.unwrap_or_else(|| PathBuf::from(".cache")).join("huggingface")
        });
        let stored = || {
            let path = get("HF_TOKEN_PATH").map_or_else(|| home.join("token"), PathBuf::from);
            let text = std::fs::read_to_string(path).ok()?;
            Some(text.trim().to_owned()).filter(|t| !t.is_empty() && !on("HF_HUB_DISABLE_IMPLICIT_TOKEN"))
        };
        let cache = get("HF_HUB_CACHE").or_else(|| get("HUGGINGFACE_HUB_CACHE")).map(PathBuf::from);
        Self {
            endpoint: get("HF_ENDPOINT").unwrap_or_else(|| "https://huggingface.co".to_owned()),
            token: get("HF_TOKEN").or_else(stored),
            cache: cache.unwrap_or_else(|| home.join("hub")),
            offline: on("HF_HUB_OFFLINE"),
        }
    }
}

/// What is published.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Publication {
    /// Where to; a revision names the branch.
    pub address: Address,
    /// Checkpoint folder.
    pub dir: PathBuf,
    /// Nobody else may see a repository that this makes.
    pub private: bool,
    /// Licence of the weights, by its name on the hub, for example `mit`.
    pub license: Option<String>,
}

/// The folder of a checkpoint: `checkpoint` itself, or where an `hf://` address was fetched to. Both files of a fetched
/// checkpoint are of one commit, and the weights are those that its description names.
///
/// # Errors
/// One line that says what to do: no such repository, revision or checkpoint, a token that is missing or wrong, no network,
/// a transfer that broke off, a build without the client. Nothing that is not whole is left where a reader looks.
pub fn resolve(checkpoint: &str, settings: &Settings) -> Result<PathBuf> {
    if !checkpoint.starts_with(SCHEME) {
        return Ok(PathBuf::from(checkpoint));
    }
    let address: Address = checkpoint.parse()?;
    #[cfg(feature = "hub")]
    return client::fetch(&address, settings);
    #[cfg(not(feature = "hub"))]
    {
        let _ = settings;
        Err(Error::Hub { address: address.to_string(), problem: WITHOUT.to_owned() })
    }
}

/// Publishes a checkpoint folder with its model card and curve as one commit; the address of what was made. The folder's own
/// `README.md` is the card where it has front matter.
///
/// # Errors
/// Before anything is sent: when the folder is no whole checkpoint, there is no token, or `HF_HUB_OFFLINE` is set. Later as
/// [`resolve`].
pub fn publish(publication: &Publication, settings: &Settings) -> Result<String> {
    let files = card::files(publication)?;
    #[cfg(feature = "hub")]
    return client::publish(publication, files, settings);
    #[cfg(not(feature = "hub"))]
    {
        let _ = (files, settings);
        Err(Error::Hub { address: publication.address.to_string(), problem: WITHOUT.to_owned() })
    }
}

/// Files by their names in the repository, read before anything is sent: what was checked is what is sent.
type Files = Vec<(&'static str, Vec<u8>)>;

fn read_if_there(path: &Path) -> Result<Option<String>> {
    match e2h_data::read_text(path) {
        Ok(text) => Ok(Some(text)),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(crate::directory::io("reading", path)(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_and_written() {
        let a: Address = "hf://lab-1/nut_assembly.v2@refs/pr/3".parse().unwrap();
        assert_eq!((a.owner.as_str(), a.name.as_str()), ("lab-1", "nut_assembly.v2"));
        assert_eq!(a.to_string(), "hf://lab-1/nut_assembly.v2@refs/pr/3");
        assert_eq!("lab/x".parse::<Address>().unwrap().to_string(), "hf://lab/x");
        for bad in [
            "hf://",
            "hf://lab",
            "lab/x/y",
            "../x",
            "lab/..",
            "lab/x@",
            "lab/x@..",
            "lab/x@a b",
            "l b/x",
            "/x",
        ] {
            let message = bad.parse::<Address>().unwrap_err().to_string();
            assert!(message.contains("expected hf://OWNER/NAME"), "{bad}: {message}");
        }
    }

    #[test]
    fn the_environment_is_honoured_as_by_other_clients() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("token"), "stored\n").unwrap();
        let home = dir.path().to_str().unwrap().to_owned();
        let with = |pairs: &[(&str, &str)]| {
            let pairs: Vec<(String, String)> =
                pairs.iter().map(|(k, v)| ((*k).to_owned(), v.replace("DIR", &home))).collect();
            Settings::from(move |name| pairs.iter().find(|(k, _)| k == name).map(|(_, v)| v.clone()))
        };
        let plain = with(&[("HOME", "/h")]);
        assert_eq!(plain.endpoint, "https://huggingface.co");
        assert_eq!(plain.cache, Path::new("/h/.cache/huggingface/hub"));
        assert!(plain.token.is_none() && !plain.offline);
        let stored = with(&[("HF_HOME", "DIR"), ("HF_HUB_OFFLINE", "true")]);
        assert_eq!((stored.token.as_deref(), stored.offline), (Some("stored"), true));
        assert_eq!(stored.cache, dir.path().join("hub"));
        let given = with(&[
            ("HF_HOME", "DIR"),
            ("HF_TOKEN", "given"),
            ("HF_HUB_CACHE", "/c"),
            ("HF_ENDPOINT", "http://e"),
        ]);
        assert_eq!(
            (given.token.as_deref(), given.cache.as_path(), given.endpoint.as_str()),
            (Some("given"), Path::new("/c"), "http://e")
        );
        assert!(with(&[("HF_HOME", "DIR"), ("HF_HUB_DISABLE_IMPLICIT_TOKEN", "1")]).token.is_none());
        assert!(!format!("{given:?}").contains("given"), "a token must not be printed");
    }

    #[test]
    fn folders_need_no_hub() {
        let settings = Settings::from(|_| None);
        assert_eq!(resolve("checkpoints/x", &settings).unwrap(), Path::new("checkpoints/x"));
        assert!(resolve("hf://nobody", &settings).unwrap_err().to_string().contains("expected hf://"));
    }

    #[cfg(not(feature = "hub"))]
    #[test]
    fn without_the_client_one_line_says_how_to_get_it() {
        let message = resolve("hf://lab/x", &Settings::from(|_| None)).unwrap_err().to_string();
        assert_eq!(message, "hf://lab/x: this build has no hub client; build with `--features hub`");
    }
}
