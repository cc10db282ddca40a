//! The one thread that has the policy: it answers all requests that wait with one call of the network.

use crate::metrics::Metrics;
use crate::servable::{Seen, Servable};
use crate::{Error, Result};
use e2h_core::Rng;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::{mpsc, oneshot};

/// A request that waits.
pub(crate) struct Job {
    pub(crate) history: Vec<Seen>,
    pub(crate) rng: Rng,
    pub(crate) reply: oneshot::Sender<Result<Answer>>,
}

/// What the network said.
pub(crate) struct Answer {
    pub(crate) actions: Vec<Vec<f32>>,
    /// The request's stream, as far as it was used.
    pub(crate) rng: Rng,
    pub(crate) infer_ms: f64,
}

/// Answers until nobody can ask any more.
pub(crate) fn answer(
    policy: &dyn Servable,
    mut jobs: mpsc::Receiver<Job>,
    max_batch: usize,
    metrics: &Arc<Metrics>,
) {
    while let Some(first) = jobs.blocking_recv() {
        let mut batch = vec![first];
        while batch.len() < max_batch {
            let Ok(job) = jobs.try_recv() else { break };
            batch.push(job);
        }
        // Whoever has gone needs no answer.
        batch.retain(|job| !job.reply.is_closed());
        if !batch.is_empty() {
            run(policy, batch, metrics);
        }
    }
}

fn run(policy: &dyn Servable, batch: Vec<Job>, metrics: &Metrics) {
    let start = Instant::now();
    let (mut histories, mut rngs, mut replies) = (vec![], vec![], vec![]);
    for job in batch {
        histories.push(job.history);
        rngs.push(job.rng);
        replies.push(job.reply);
    }
    // Kept for the case that one request spoils the call for the others.
    let alone = (replies.len() > 1).then(|| (histories.clone(), rngs.clone()));
    metrics.batch.observe(replies.len() as f64);
    let done = call(policy, histories, &mut rngs);
    let seconds = start.elapsed().as_secs_f64();
    metrics.inference.observe(seconds);
    let infer_ms = seconds * 1e3;
    match (done, alone) {
        (Ok(chunks), _) => {
            for ((reply, actions), rng) in replies.into_iter().zip(chunks).zip(rngs) {
                // A client that has gone in the meantime misses nothing.
                let _ = reply.send(Ok(Answer { actions, rng, infer_ms }));
            }
        }
        (Err(_), Some((histories, rngs))) => {
            for ((reply, history), rng) in replies.into_iter().zip(histories).zip(rngs) {
                run(policy, vec![Job { history, rng, reply }], metrics);
            }
        }
        (Err(error), None) => {
            if let Some(reply) = replies.pop() {
                let _ = reply.send(Err(error));
            }
        }
    }
}

/// One call; a policy that panics has given no answer, and the server goes on.
fn call(policy: &dyn Servable, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> Result<Vec<Vec<Vec<f32>>>> {
    let expected = histories.len();
    let chunks = catch_unwind(AssertUnwindSafe(|| policy.act(histories, rngs)))
        .map_err(|_| Error::Inference("it panicked".to_owned()))??;
    if chunks.len() != expected {
        return Err(Error::Inference(format!("expected {expected} chunks of actions, got {}", chunks.len())));
    }
    if chunks.iter().flatten().flatten().any(|v| !v.is_finite()) {
        return Err(Error::Inference("expected finite actions, got others".to_owned()));
    }
    Ok(chunks)
}
