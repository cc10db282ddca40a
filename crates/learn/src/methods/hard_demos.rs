use crate::method::{Lesson, Method, Round, Tools};
use crate::{Demonstrations, Result, RunConfig};
use e2h_core::Direction;
use e2h_data::Source;
use e2h_refine::kinematic_filter;
use std::sync::Arc;

/// Hard demonstrations: as many of the hard task as the others have of the easy one, and no loop.
///
/// # Source
/// The paper's cost table.
#[derive(Debug, Clone, Copy, Default)]
pub struct HardDemos;

impl Method for HardDemos {
    fn name(&self) -> &str {
        "hard-demos"
    }

    fn initial(&self, _: &Demonstrations, config: &RunConfig, tools: &Tools<'_>) -> Result<Vec<Source>> {
        let r = &config.refine;
        let recorded = tools.demonstrations(Direction::Hard)?;
        let episodes = recorded.into_iter().flat_map(|e| {
            if config.closed_loop.refine_demonstrations {
                kinematic_filter(&e, &r.kinematic, &r.reverse).segments
            } else {
                vec![e]
            }
        });
        Ok(vec![Source::whole(episodes.map(Arc::new).collect())])
    }

    fn lesson(&self, _: &Round<'_>, _: &Tools<'_>) -> Result<Lesson> {
        Ok(Lesson {
            notes: vec!["hard demonstrations alone: the loop teaches nothing".to_owned()],
            ..Lesson::default()
        })
    }
}
