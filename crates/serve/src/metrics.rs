//! What a server counts, as Prometheus reads it.

use crate::{Error, Result};
use prometheus::{Histogram, HistogramOpts, IntCounter, IntGauge, Registry, TextEncoder};

/// Counts of a server since it began.
pub(crate) struct Metrics {
    registry: Registry,
    pub(crate) requests: IntCounter,
    pub(crate) errors: IntCounter,
    pub(crate) refused: IntCounter,
    pub(crate) clients: IntGauge,
    pub(crate) batch: Histogram,
    pub(crate) latency: Histogram,
    pub(crate) inference: Histogram,
}

impl Metrics {
    pub(crate) fn new() -> Result<Self> {
        Self::build().map_err(|e| Error::Io { doing: "metrics".to_owned(), source: std::io::Error::other(e) })
    }

    fn build() -> prometheus::Result<Self> {
        let registry = Registry::new();
        let counter = |name: &str, help: &str| {
            let counter = IntCounter::new(name, help)?;
            registry.register(Box::new(counter.clone()))?;
            prometheus::Result::Ok(counter)
        };
        let histogram = |name: &str, help: &str, buckets: &[f64]| {
            let histogram = Histogram::with_opts(HistogramOpts::new(name, help).buckets(buckets.to_vec()))?;
            registry.register(Box::new(histogram.clone()))?;
            prometheus::Result::Ok(histogram)
        };
        let seconds = [0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0];
        let sizes = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0];
        let requests = counter("e2h_serve_requests_total", "Requests that were answered with actions.")?;
        let errors = counter("e2h_serve_errors_total", "Requests that were answered with an error.")?;
        let refused = counter("e2h_serve_refused_total", "Connections that were refused.")?;
        let clients = IntGauge::new("e2h_serve_clients", "Clients that are connected.")?;
        registry.register(Box::new(clients.clone()))?;
        let batch =
            histogram("e2h_serve_batch_size", "Requests that one call of the network answered.", &sizes)?;
        let latency = histogram(
            "e2h_serve_latency_seconds",
            "Time from a request that has arrived to its answer, waiting included.",
            &seconds,
        )?;
        let inference =
            histogram("e2h_serve_inference_seconds", "Time of one call of the network.", &seconds)?;
        Ok(Self { requests, errors, refused, clients, batch, latency, inference, registry })
    }

    /// The text of `/metrics`.
    pub(crate) fn text(&self) -> prometheus::Result<String> {
        TextEncoder::new().encode_to_string(&self.registry.gather())
    }
}
