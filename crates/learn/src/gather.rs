//! What lanes on several ranks brought, at rank 0: rollouts, trials and pictures on their way between processes.

use crate::collect::Collected;
use crate::record::{Automatic, ResetCause, Trial};
use crate::{Error, Result};
use e2h_core::{Episode, Excursion, Frames, Image, ImageStore, Origin, Outcome, Team};
use e2h_env::Env;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Simulations of this rank, each with the number of its lane. What a lane does depends on its number and on how many there are, and
/// not on the rank that has it.
pub(crate) struct Lanes<'a> {
    pub(crate) envs: Vec<(usize, Env)>,
    /// Lanes of all ranks.
    pub(crate) all: usize,
    pub(crate) team: &'a dyn Team,
}

impl Lanes<'static> {
    /// All lanes in this process.
    pub(crate) fn alone(envs: Vec<Env>) -> Self {
        Self { all: envs.len(), envs: envs.into_iter().enumerate().collect(), team: &e2h_core::Solo }
    }
}

pub(crate) fn to_json<T: Serialize>(value: &T) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|e| Error::Team(format!("expected a value that JSON can say: {e}")))
}

pub(crate) fn from_json<T: DeserializeOwned>(bytes: &[u8]) -> Result<T> {
    serde_json::from_slice(bytes)
        .map_err(|e| Error::Team(format!("expected another rank of this program, found other words: {e}")))
}

/// What is said of an episode before its numbers.
#[derive(Serialize, Deserialize)]
struct Head {
    origin: Origin,
    outcome: Outcome,
    terminal: bool,
    rows: usize,
    /// Name, height, width.
    cameras: Vec<(String, usize, usize)>,
}

/// An episode as bytes: length of the head, head, columns, images.
fn pack(episode: &Episode) -> Result<Vec<u8>> {
    let head = to_json(&Head {
        origin: episode.origin.clone(),
        outcome: episode.outcome,
        terminal: episode.terminal,
        rows: episode.len(),
        cameras: episode.frames.iter().map(|f| (f.camera.clone(), f.height, f.width)).collect(),
    })?;
    let mut bytes = (head.len() as u64).to_le_bytes().to_vec();
    bytes.extend(head);
    let numbers = episode.state.iter().flatten().chain(episode.action.iter().flatten());
    for number in numbers.chain(episode.excursion.iter().flatten()) {
        bytes.extend(number.to_le_bytes());
    }
    for row in &episode.source {
        bytes.extend(row.to_le_bytes());
    }
    for image in episode.frames.iter().flat_map(|f| &f.images) {
        bytes.extend_from_slice(&image.read()?);
    }
    Ok(bytes)
}

/// Takes bytes from the front of a message.
struct Rest<'a>(&'a [u8]);

impl<'a> Rest<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8]> {
        let found = self.0.len();
        let (taken, rest) = self.0.split_at_checked(n).ok_or_else(|| {
            Error::Team(format!("message of another rank: expected {n} bytes more, found {found}"))
        })?;
        self.0 = rest;
        Ok(taken)
    }

    fn length(&mut self) -> Result<usize> {
        let bytes = self.take(8)?.first_chunk().copied().unwrap_or_default();
        Ok(usize::try_from(u64::from_le_bytes(bytes)).unwrap_or(usize::MAX))
    }

    /// Rows of `N` numbers.
    fn rows<const N: usize>(&mut self, rows: usize) -> Result<Vec<[f32; N]>> {
        let bytes = self.take(rows.saturating_mul(4 * N))?;
        let numbers: Vec<f32> = bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        Ok(numbers.as_chunks().0.to_vec())
    }
}

fn unpack(bytes: &[u8]) -> Result<Episode> {
    let mut rest = Rest(bytes);
    let length = rest.length()?;
    let head: Head = from_json(rest.take(length)?)?;
    let rows = head.rows;
    let (state, action) = (rest.rows(rows)?, rest.rows(rows)?);
    let excursion: Vec<Excursion> = rest.rows(rows)?;
    let source = rest.take(rows.saturating_mul(4))?;
    let source = source.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
    let mut frames = vec![];
    for (camera, height, width) in head.cameras {
        let bytes = [height, width, 3].into_iter().fold(rows, usize::saturating_mul);
        frames.push(Frames::new(&camera, height, width, rest.take(bytes)?));
    }
    let episode = Episode {
        state,
        action,
        frames,
        source,
        excursion,
        outcome: head.outcome,
        terminal: head.terminal,
        origin: head.origin,
    };
    episode.validate()?;
    Ok(episode)
}

/// [`Collected`] without its episodes.
#[derive(Serialize, Deserialize)]
struct Counts {
    episodes: usize,
    easy_rollouts: usize,
    easy_successes: usize,
    steps: usize,
    resets: BTreeMap<ResetCause, usize>,
    explored: Automatic,
    plain: Automatic,
}

/// What all ranks collected, at rank 0; nothing at the others. Episodes travel one a rank at a time, and their images go to `images`
/// at once, so that memory holds no round.
pub(crate) fn collected(team: &dyn Team, mine: Collected, images: Option<&ImageStore>) -> Result<Collected> {
    if team.size() == 1 {
        return Ok(mine);
    }
    let Collected { hard, easy, rejected, easy_rollouts, easy_successes, steps, resets, explored, plain } =
        mine;
    let lists = [hard, easy, rejected];
    let episodes = lists.iter().map(Vec::len).sum();
    let counts = Counts { episodes, easy_rollouts, easy_successes, steps, resets, explored, plain };
    let mut all = Collected::default();
    let mut most = 0;
    for counts in team.gather(to_json(&counts)?)? {
        let c: Counts = from_json(&counts)?;
        most = most.max(c.episodes);
        all.easy_rollouts += c.easy_rollouts;
        all.easy_successes += c.easy_successes;
        all.steps += c.steps;
        all.explored += c.explored;
        all.plain += c.plain;
        for (cause, n) in c.resets {
            *all.resets.entry(cause).or_default() += n;
        }
    }
    let mut rounds = to_json(&most)?;
    team.broadcast(&mut rounds)?;
    let mut own = lists.iter().zip(0u8..).flat_map(|(list, kind)| list.iter().map(move |e| (kind, e)));
    for _ in 0..from_json::<usize>(&rounds)? {
        let mut bytes = vec![];
        if let Some((kind, episode)) = own.next() {
            bytes = pack(episode)?;
            bytes.push(kind);
        }
        for bytes in team.gather(bytes)? {
            let Some((kind, bytes)) = bytes.split_last() else { continue };
            let mut episode = unpack(bytes)?;
            if let Some(store) = images {
                episode.store_images(store)?;
            }
            match kind {
                0 => all.hard.push(episode),
                1 => all.easy.push(episode),
                _ => all.rejected.push(episode),
            }
        }
    }
    for list in [&mut all.hard, &mut all.easy, &mut all.rejected] {
        list.sort_by_key(|e| e.origin.episode);
    }
    Ok(all)
}

/// The trials of all ranks in their order, on every rank.
pub(crate) fn trials(team: &dyn Team, mine: &[(usize, Trial)]) -> Result<Vec<(usize, Trial)>> {
    let mut all: Vec<(usize, Trial)> = vec![];
    for bytes in team.gather(to_json(&mine)?)? {
        all.extend(from_json::<Vec<(usize, Trial)>>(&bytes)?);
    }
    all.sort_by_key(|(i, _)| *i);
    let mut bytes = to_json(&all)?;
    team.broadcast(&mut bytes)?;
    from_json(&bytes)
}

/// The film that one of the ranks has, at rank 0; none where none has it, and at the others.
pub(crate) fn film(team: &dyn Team, mine: Option<Vec<Image>>) -> Result<Option<Vec<Image>>> {
    if team.size() == 1 {
        return Ok(mine);
    }
    let mut bytes = vec![];
    for image in mine.iter().flatten() {
        bytes.extend([image.height, image.width].iter().flat_map(|n| (*n as u64).to_le_bytes()));
        bytes.extend_from_slice(&image.data);
    }
    let Some(bytes) = team.gather(bytes)?.into_iter().find(|bytes| !bytes.is_empty()) else {
        return Ok(None);
    };
    let (mut rest, mut images) = (Rest(&bytes), vec![]);
    while !rest.0.is_empty() {
        let (height, width) = (rest.length()?, rest.length()?);
        let data = rest.take([width, 3].into_iter().fold(height, usize::saturating_mul))?.to_vec();
        images.push(Image { height, width, data });
    }
    Ok(Some(images))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;
    use e2h_core::{Direction, Kind, Observation, Threads};

    fn episode(number: u32, rows: usize) -> Episode {
        let mut origin = Origin::demonstration("t", Direction::Easy, number, u64::MAX);
        origin.kind = Kind::Rollout;
        let mut e = Episode::new(origin, &["table".to_owned(), "wrist".to_owned()]);
        for t in 0..rows {
            let v = 0.1 + t as f32 + number as f32 / 3.0;
            let image = |side: usize| Image {
                height: side,
                width: side + 1,
                data: vec![t as u8; side * (side + 1) * 3],
            };
            let seen = Observation { state: [v; 15], frames: vec![image(2), image(3)] };
            e.push(&seen, &[-v; 8]).unwrap();
            e.excursion[t] = [v, 0.0, 1e-30, -0.0];
        }
        e.outcome = Outcome::Success { at: 1 };
        e.terminal = false;
        e
    }

    #[test]
    fn an_episode_arrives_as_it_left_and_one_cut_short_is_refused() {
        for rows in [0, 1, 5] {
            let e = episode(3, rows);
            let bytes = pack(&e).unwrap();
            assert_eq!(unpack(&bytes).unwrap(), e);
            let message = unpack(&bytes[..bytes.len() - 1]).unwrap_err().to_string();
            assert!(message.contains("expected"), "{message}");
        }
    }

    #[test]
    fn what_ranks_collected_is_at_the_first_in_the_order_of_cycles() {
        let folder = tempfile::tempdir().unwrap();
        let all = Threads::run(3, |team| {
            let n = u32::try_from(team.rank()).unwrap();
            let hard = (0..=n).map(|i| episode(3 * i + n, 2)).collect();
            let resets = BTreeMap::from([(ResetCause::Start, team.rank())]);
            let mine =
                Collected { hard, easy: vec![episode(n, 1)], steps: 5, resets, ..Collected::default() };
            let store = ImageStore::create(folder.path()).unwrap();
            collected(&team, mine, Some(&store)).unwrap()
        });
        let cycles: Vec<u32> = all[0].hard.iter().map(|e| e.origin.episode).collect();
        assert_eq!(cycles, [0, 1, 2, 4, 5, 8]);
        assert!(all[0].hard.iter().all(|e| !e.frames[0].images[0].in_memory()));
        assert_eq!((all[0].easy.len(), all[0].steps, all[0].resets[&ResetCause::Start]), (3, 15, 3));
        assert!(all[1].hard.is_empty() && all[2].easy.is_empty());
    }

    #[test]
    fn trials_and_films_are_where_they_are_wanted() {
        let all = Threads::run(2, |team| {
            let trial = Trial { outcome: Outcome::Timeout, steps: team.rank() };
            let image = Image { height: 1, width: 2, data: vec![9; 6] };
            let mine = (team.rank() == 1).then(|| vec![image.clone(), image]);
            (trials(&team, &[(1 - team.rank(), trial)]).unwrap(), film(&team, mine).unwrap())
        });
        let steps = |all: &[(usize, Trial)]| all.iter().map(|(i, t)| (*i, t.steps)).collect::<Vec<_>>();
        assert_eq!(steps(&all[0].0), [(0, 1), (1, 0)]);
        assert_eq!(all[0].0, all[1].0);
        assert_eq!(all[0].1.as_ref().map(Vec::len), Some(2));
        assert!(all[1].1.is_none());
    }
}
