//! Speaking to the hub through `hf-hub`.

use super::{Address, Files, MAIN, Publication, Settings};
use crate::{Error, Result};
use e2h_policy::Checkpoint;
use hf_hub::repository::CommitOperation;
use hf_hub::{HFClient, HFClientSync, HFError, HFRepositorySync, RepoTypeModel};
use std::path::{Path, PathBuf};

/// Tries of a request beyond the first.
const RETRIES: usize = 2;

fn error(address: &Address, problem: impl Into<String>) -> Error {
    Error::Hub { address: address.to_string(), problem: problem.into() }
}

fn client(address: &Address, settings: &Settings) -> Result<HFClientSync> {
    let mut builder = HFClient::builder()
        .endpoint(&settings.endpoint)
        .cache_dir(&settings.cache)
        .user_agent(concat!("auto-e2h/", env!("CARGO_PKG_VERSION")))
        .retry_max_attempts(RETRIES);
    if let Some(token) = &settings.token {
        builder = builder.token(token);
    }
    builder.build_sync().map_err(|e| say(address, settings, e))
}

/// One line for what the hub or the network answered.
fn say(address: &Address, settings: &Settings, e: HFError) -> Error {
    let private = if settings.token.is_some() {
        "is the token (HF_TOKEN) of somebody who may see it?"
    } else {
        "a private one needs a token (HF_TOKEN)"
    };
    let missing = |what: String| format!("{} has no {what}; {private}", settings.endpoint);
    let problem = match &e {
        HFError::AuthRequired { .. } => match &settings.token {
            Some(_) => format!("{} refused the token; is HF_TOKEN right and not expired?", settings.endpoint),
            None => {
                format!("{} has no such public repository; for a private one set HF_TOKEN", settings.endpoint)
            }
        },
        HFError::Forbidden { .. } => {
            format!("{} does not allow it with this token; may it read and write there?", settings.endpoint)
        }
        HFError::RepoNotFound { .. } => missing("such repository".to_owned()),
        HFError::RevisionNotFound { revision, .. } => missing(format!("revision `{revision}` of it")),
        HFError::EntryNotFound { path, .. } => missing(format!("file {path} there (or no such repository)")),
        HFError::LocalEntryNotFound { path } if settings.offline => {
            format!("HF_HUB_OFFLINE is set, and {path} is not in {}", settings.cache.display())
        }
        HFError::Request { source, .. } if source.is_connect() || source.is_timeout() => {
            format!("cannot reach {}: {}", settings.endpoint, root(source))
        }
        HFError::Request { source, .. } => format!("the transfer broke off: {}", root(source)),
        other => other.to_string(),
    };
    // A server's message may have any number of lines.
    error(address, problem.split_whitespace().collect::<Vec<_>>().join(" "))
}

/// What lies under an error: the layers above it only say that something failed.
fn root(e: &dyn std::error::Error) -> String {
    let mut e = e;
    while let Some(source) = e.source() {
        e = source;
    }
    e.to_string()
}

pub(super) fn fetch(address: &Address, settings: &Settings) -> Result<PathBuf> {
    let client = client(address, settings)?;
    let repository = client.model(&address.owner, &address.name);
    let get = |file: &str, revision: &str| -> Result<PathBuf> {
        let request = repository.download_file().filename(file).revision(revision);
        request.local_files_only(settings.offline).send().map_err(|e| say(address, settings, e))
    };
    let config = get("policy.json", address.revision.as_deref().unwrap_or(MAIN))?;
    // <cache>/models--owner--name/snapshots/<commit>/policy.json: the weights have to be of the same commit, whatever is pushed
    // meanwhile.
    let folder = config.parent().map(Path::to_owned).unwrap_or_default();
    let commit = folder.file_name().map(|n| n.to_string_lossy().into_owned());
    let commit = commit.ok_or_else(|| error(address, "the cache has no commit in its path"))?;
    let weights = get("model.safetensors", &commit)?;
    match Checkpoint::read(&folder) {
        Ok(_) => Ok(folder),
        Err(e) => {
            // What came is not what was published: it must not stay, or every later try would find it.
            for file in [&config, &weights] {
                let blob = std::fs::canonicalize(file);
                drop(std::fs::remove_file(file));
                if let Ok(blob) = blob {
                    drop(std::fs::remove_file(blob));
                }
            }
            Err(error(
                address,
                format!("what came is no whole checkpoint and was removed from the cache: {e}"),
            ))
        }
    }
}

pub(super) fn publish(publication: &Publication, files: Files, settings: &Settings) -> Result<String> {
    let address = &publication.address;
    if settings.offline {
        return Err(error(address, "nothing is published while HF_HUB_OFFLINE is set"));
    }
    if settings.token.is_none() {
        return Err(error(address, "publishing needs a token: set HF_TOKEN, or log in with `hf auth login`"));
    }
    let client = client(address, settings)?;
    let repository: HFRepositorySync<RepoTypeModel> = client.model(&address.owner, &address.name);
    client
        .create_repository()
        .repo_type(RepoTypeModel)
        .repo_id(&repository.repo_path())
        .private(publication.private)
        .exist_ok(true)
        .send()
        .map_err(|e| say(address, settings, e))?;
    let operation = |(name, bytes)| CommitOperation::add_bytes(name, bytes);
    // One commit: nobody ever fetches the weights of one policy with the description of another.
    repository
        .create_commit()
        .operations(files.into_iter().map(operation).collect())
        .commit_message("Publish a policy")
        .revision(address.revision.as_deref().unwrap_or(MAIN))
        .send()
        .map_err(|e| say(address, settings, e))?;
    Ok(format!("{}/{}/{}", settings.endpoint.trim_end_matches('/'), address.owner, address.name))
}
