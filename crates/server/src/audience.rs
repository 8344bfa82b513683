//! Who is there, and who follows whom: a viewer that follows another gets the frames that are made for that one.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::wire::{PoseRequest, ViewerEntry};
use isinglass_render::MadeFrame;
use tokio::sync::{Notify, watch};
use tokio::time::Instant;

use crate::frame_memory::Held;
use crate::selection::SceneNumber;

/// All viewers of a server. Clones share them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Audience(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    viewers: Mutex<BTreeMap<ViewerId, Member>>,
    changed: watch::Sender<()>,
}

#[derive(Debug)]
struct Member {
    name: String,
    follows: Option<ViewerId>,
    /// `None` once it has left.
    session: Option<u64>,
    left_at: Option<Instant>,
    stage: Arc<Stage>,
}

/// What a viewer shows to those that follow it.
#[derive(Debug, Default)]
struct Stage {
    newest: watch::Sender<Option<Arc<LedFrame>>>,
    joined: Notify,
}

/// A frame of a viewer that others follow.
#[derive(Debug)]
pub(crate) struct LedFrame {
    pub(crate) request: PoseRequest,
    pub(crate) look: Look,
    pub(crate) scene: SceneNumber,
    pub(crate) frame: MadeFrame,
    pub(crate) is_draft: bool,
    pub(crate) _held: Held,
}

/// Why nobody is followed.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
pub(crate) enum FollowError {
    /// The viewer is not there.
    #[error("the viewer to follow has left")]
    Left,
    /// The viewer follows the one that asks, perhaps through others.
    #[error("that viewer follows this one")]
    Circle,
}

impl Audience {
    /// A viewer has come, under a name.
    pub(crate) fn enter(&self, viewer: ViewerId, session: u64, name: &str) -> Presence {
        let mut viewers = self.viewers();
        let now = Instant::now();
        viewers.retain(|id, member| *id == viewer || !member.is_gone(now));
        let member = viewers.entry(viewer).or_insert_with(|| Member {
            name: String::new(),
            follows: None,
            session: None,
            left_at: None,
            stage: Arc::default(),
        });
        (member.name, member.session, member.left_at) = (name.to_owned(), Some(session), None);
        member.follows = None;
        let stage = member.stage.clone();
        drop(viewers);
        self.0.changed.send_replace(());
        Presence { audience: self.clone(), viewer, session, stage }
    }

    /// Lets a viewer follow another; returns that one's frames, or `None` if it has its own again.
    ///
    /// # Errors
    /// If the other one is not there, or follows this one.
    pub(crate) fn follow(
        &self,
        viewer: ViewerId,
        leader: Option<ViewerId>,
    ) -> Result<Option<Following>, FollowError> {
        let mut viewers = self.viewers();
        let mut next = leader;
        while let Some(ahead) = next {
            if ahead == viewer {
                return Err(FollowError::Circle);
            }
            let ahead = viewers.get(&ahead).filter(|member| member.session.is_some());
            next = ahead.ok_or(FollowError::Left)?.follows;
        }
        if let Some(member) = viewers.get_mut(&viewer) {
            member.follows = leader;
        }
        let stage = leader.and_then(|leader| viewers.get(&leader)).map(|member| member.stage.clone());
        drop(viewers);
        self.0.changed.send_replace(());
        Ok(stage.zip(leader).map(|(stage, leader)| {
            let newest = stage.newest.subscribe();
            stage.joined.notify_one();
            Following { leader, stage, newest }
        }))
    }

    /// Whether a viewer has been away for so long that nobody waits for it.
    pub(crate) fn is_gone(&self, viewer: ViewerId) -> bool {
        self.viewers().get(&viewer).is_none_or(|member| member.is_gone(Instant::now()))
    }

    /// Who is there, as a viewer should see it.
    pub(crate) fn list(&self, own: ViewerId) -> Vec<ViewerEntry> {
        let viewers = self.viewers();
        let here = viewers.iter().filter(|(_, member)| member.session.is_some());
        let entry = |(id, member): (&ViewerId, &Member)| ViewerEntry {
            number: id.0,
            name: member.name.clone(),
            is_own: *id == own,
            follows: member.follows.map(|leader| leader.0),
        };
        here.map(entry).collect()
    }

    /// Notified when the list changes.
    pub(crate) fn subscribe(&self) -> watch::Receiver<()> {
        self.0.changed.subscribe()
    }

    fn viewers(&self) -> MutexGuard<'_, BTreeMap<ViewerId, Member>> {
        // Every change is one step, so a panic leaves the list in order.
        self.0.viewers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Member {
    fn is_gone(&self, now: Instant) -> bool {
        self.left_at.is_some_and(|at| now.saturating_duration_since(at) >= PATIENCE)
    }
}

/// A viewer that is there. It has left when this is dropped.
#[derive(Debug)]
pub(crate) struct Presence {
    audience: Audience,
    viewer: ViewerId,
    session: u64,
    stage: Arc<Stage>,
}

impl Presence {
    pub(crate) fn has_followers(&self) -> bool {
        self.stage.newest.receiver_count() > 0
    }

    /// Shows a frame to those that follow.
    pub(crate) fn publish(&self, frame: LedFrame) {
        self.stage.newest.send_replace(Some(Arc::new(frame)));
    }

    /// Returns when another viewer begins to follow.
    pub(crate) async fn joined(&self) {
        self.stage.joined.notified().await;
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        let mut viewers = self.audience.viewers();
        // A newer session of the same viewer stays.
        let Some(member) = viewers.get_mut(&self.viewer).filter(|m| m.session == Some(self.session)) else {
            return;
        };
        (member.session, member.follows, member.left_at) = (None, None, Some(Instant::now()));
        drop(viewers);
        self.audience.0.changed.send_replace(());
    }
}

/// The frames of a viewer that another one follows.
#[derive(Debug)]
pub(crate) struct Following {
    pub(crate) leader: ViewerId,
    stage: Arc<Stage>,
    newest: watch::Receiver<Option<Arc<LedFrame>>>,
}

impl Following {
    /// The next frame. Cancellation loses nothing.
    pub(crate) async fn next(&mut self) -> Arc<LedFrame> {
        loop {
            if self.newest.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
            if let Some(frame) = self.newest.borrow_and_update().clone() {
                return frame;
            }
        }
    }
}

impl Drop for Following {
    fn drop(&mut self) {
        // Without anybody who follows, the last frame takes memory for nothing.
        if self.stage.newest.receiver_count() == 1 {
            self.stage.newest.send_replace(None);
        }
    }
}

/// A viewer that has lost its connection may come back; others wait for so long.
pub(crate) const PATIENCE: Duration = Duration::from_secs(15);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_follows_in_a_circle_or_whom_is_not_there() {
        let audience = Audience::default();
        let [a, b, c] = [0, 1, 2].map(ViewerId);
        let _a = audience.enter(a, 1, "a");
        let _b = audience.enter(b, 2, "b");
        assert!(matches!(audience.follow(a, Some(c)), Err(FollowError::Left)));
        assert!(matches!(audience.follow(a, Some(a)), Err(FollowError::Circle)));
        assert!(audience.follow(b, Some(a)).unwrap().is_some());
        assert!(matches!(audience.follow(a, Some(b)), Err(FollowError::Circle)));
        let _c = audience.enter(c, 3, "c");
        assert!(audience.follow(c, Some(b)).unwrap().is_some());
        assert!(matches!(audience.follow(a, Some(c)), Err(FollowError::Circle)));
        let follows: Vec<_> = audience.list(c).iter().map(|viewer| (viewer.is_own, viewer.follows)).collect();
        assert_eq!(follows, [(false, None), (false, Some(0)), (true, Some(1))]);
        // The control: once it has its own frames, it may be followed.
        assert!(audience.follow(b, None).unwrap().is_none());
        assert!(audience.follow(a, Some(b)).unwrap().is_some());
    }

    #[tokio::test(start_paused = true)]
    async fn who_comes_back_soon_is_still_followed() {
        let audience = Audience::default();
        let [a, b] = [0, 1].map(ViewerId);
        let (first, _b) = (audience.enter(a, 1, "a"), audience.enter(b, 2, "b"));
        let _following = audience.follow(b, Some(a)).unwrap().unwrap();
        assert!(first.has_followers());
        // The newer session comes before the older one has ended.
        let second = audience.enter(a, 3, "a");
        drop(first);
        assert_eq!(audience.list(b).len(), 2);
        drop(second);
        assert_eq!(audience.list(b).len(), 1);
        tokio::time::advance(PATIENCE / 2).await;
        assert!(!audience.is_gone(a));
        let third = audience.enter(a, 4, "a");
        assert!(third.has_followers(), "the one that follows has waited");
        drop(third);
        tokio::time::advance(PATIENCE).await;
        assert!(audience.is_gone(a) && !audience.is_gone(b));
    }
}
