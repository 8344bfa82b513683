//! What a viewer asks of single points. Of a volume that is read by pages, the answer first has what is in memory, and
//! finer values when those are read. Of a volume in several processes, these find the answer.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_core::session::ServerSession;
use isinglass_core::session::inquiry::{InquiryServer, Question};
use isinglass_core::volume::AskedPoints;
use isinglass_net::server::Control;
use isinglass_render::Workers;

use crate::give_up::GiveUp;
use crate::paging::Pager;
use crate::selection::Present;

/// The answers that are being read. When this is dropped, all are given up.
pub(super) struct Inquiries {
    control: Control,
    probe: Option<GiveUp>,
    profile: Option<GiveUp>,
    /// The processes that have the volume, if they are several.
    workers: Option<Arc<dyn Workers>>,
    /// Whether they look something up.
    probing: Arc<AtomicBool>,
    profiling: Arc<AtomicBool>,
}

impl Inquiries {
    pub(super) fn new(control: Control, workers: Option<Arc<dyn Workers>>) -> Self {
        let (probing, profiling) = Default::default();
        Self { control, probe: None, profile: None, workers, probing, profiling }
    }

    /// Another volume is shown: what is looked up in the one before is of no use.
    pub(super) fn give_up(&mut self) {
        (self.probe, self.profile) = (None, None);
    }

    /// Answers what is asked.
    pub(super) fn answer(&mut self, talk: &mut ServerSession, present: &Arc<Present>) {
        // Pages are read here, whosever part they are.
        if let Some(workers) = self.workers.as_ref().filter(|_| present.pager.is_none()) {
            self.ask(workers, &self.probing, |talk| &mut talk.probe);
            self.ask(workers, &self.profiling, |talk| &mut talk.profile);
            return;
        }
        if talk.probe.is_asked() {
            let coarse = answer_known(&mut talk.probe, present);
            self.probe =
                coarse.and_then(|q| self.read(q, present, |talk, q, a| talk.probe.handle_finer(q, a)));
        }
        if talk.profile.is_asked() {
            let coarse = answer_known(&mut talk.profile, present);
            self.profile =
                coarse.and_then(|q| self.read(q, present, |talk, q, a| talk.profile.handle_finer(q, a)));
        }
    }

    /// Has the processes answer what is asked, one question after the other.
    fn ask<Q>(
        &self,
        workers: &Arc<dyn Workers>,
        is_asking: &Arc<AtomicBool>,
        of: impl Fn(&mut ServerSession) -> &mut InquiryServer<Q> + Send + 'static,
    ) where
        Q: Question + Send + 'static,
        Q::Answer: Send + 'static,
    {
        if is_asking.swap(true, Ordering::Relaxed) {
            // The last answer is followed by a look for the next question.
            return;
        }
        let (workers, is_asking, control) = (workers.clone(), is_asking.clone(), self.control.clone());
        tokio::spawn(async move {
            loop {
                let question = {
                    // Questions come under the same lock.
                    let mut talk = control.talk();
                    let question = of(talk.quietly()).take();
                    is_asking.store(question.is_some(), Ordering::Relaxed);
                    question
                };
                let Some(question) = question else { return };
                let workers = workers.clone();
                let work = tokio::task::spawn_blocking(move || {
                    let mut asked = AskedPoints::default();
                    question.answer_from(&mut asked);
                    Some(question.answer_from(&mut workers.values(asked)?))
                });
                if let Ok(Some(answer)) = work.await {
                    of(&mut control.talk()).handle_answer(answer);
                }
            }
        });
    }

    /// Reads the finest values, and gives them to the session.
    fn read<Q>(
        &self,
        question: Q,
        present: &Arc<Present>,
        give: impl FnOnce(&mut ServerSession, &Q, Q::Answer) + Send + 'static,
    ) -> Option<GiveUp>
    where
        Q: Question + Send + 'static,
        Q::Answer: Send + 'static,
    {
        let pager: Pager = present.pager.clone()?;
        let (given_up, present, control) = (GiveUp::default(), present.clone(), self.control.clone());
        let wanted = given_up.wanted();
        tokio::spawn(async move {
            let is_wanted = wanted.clone();
            let work = tokio::task::spawn_blocking(move || {
                pager.with_values(present.lights.volume(), Some(0), &is_wanted, |values| {
                    question.answer_from(&mut values.cursor())
                })
            });
            if let Ok(answer) = work.await
                && wanted()
            {
                give(&mut control.talk(), &question, answer);
            }
        });
        Some(given_up)
    }
}

/// Answers from what is in memory. Returns the question if finer values may be read.
fn answer_known<Q: Question>(inquiry: &mut InquiryServer<Q>, present: &Present) -> Option<Q> {
    let volume = present.lights.volume();
    let Some(pager) = &present.pager else {
        inquiry.answer(&mut &*volume);
        return None;
    };
    pager.with_values(volume, None, &|| true, |values| {
        let mut cursor = values.cursor();
        let question = inquiry.answer(&mut cursor);
        question.filter(|_| cursor.coarsest() > 0)
    })
}
