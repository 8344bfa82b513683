//! A question about the shown volume, and its answer: the newest question counts.

use super::pace::Pace;
use crate::ids::ProbeId;
use crate::volume::ValuesAt;
use crate::wire::{ClientMessage, ServerMessage};

/// What a client can ask of the shown volume.
pub trait Question: Copy + PartialEq {
    /// The answer.
    type Answer;
    /// Least time between two questions, µs.
    const PERIOD_MICROS: u64;

    /// Number of the question.
    fn id(&self) -> ProbeId;
    /// Number of the question that an answer is for.
    fn id_of(answer: &Self::Answer) -> ProbeId;
    /// The question in a message, if it is one.
    fn in_message(message: &ClientMessage) -> Option<Self>;
    /// The answer in a message, if it is one.
    fn answer_in(message: &ServerMessage) -> Option<Self::Answer>;
    /// The question as a message.
    fn to_message(self) -> ClientMessage;
    /// An answer as a message.
    fn message_of(answer: Self::Answer) -> ServerMessage;
    /// Looks the answer up.
    fn answer_from(&self, values: &mut dyn ValuesAt) -> Self::Answer;
}

/// The client's half: the newest question and the newest answer.
#[derive(Debug)]
pub struct InquiryClient<Q: Question> {
    newest: ProbeId,
    outbox: Pace<Q>,
    /// The newest question, until it is answered.
    unanswered: Option<Q>,
    answer: Option<Q::Answer>,
}

impl<Q: Question> Default for InquiryClient<Q> {
    fn default() -> Self {
        Self { newest: ProbeId(0), outbox: Pace::new(Q::PERIOD_MICROS), unanswered: None, answer: None }
    }
}

impl<Q: Question> InquiryClient<Q> {
    /// Asks what `question` makes of its number, if that is a question. Returns the number of the newest question.
    pub(super) fn ask_what(&mut self, question: impl FnOnce(ProbeId) -> Option<Q>) -> ProbeId {
        if let Some(question) = question(self.newest.next()) {
            self.newest = question.id();
            self.unanswered = Some(question);
            self.outbox.offer(self.unanswered);
        }
        self.newest
    }

    /// The newest answer.
    pub fn answer(&self) -> Option<&Q::Answer> {
        self.answer.as_ref()
    }

    /// A connection is up: an unanswered question is asked again.
    pub fn handle_welcome(&mut self) {
        self.outbox.offer(self.unanswered);
    }

    /// A message has arrived. A new volume makes the old answer useless.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        match Q::answer_in(message) {
            Some(answer) => self.handle_answer(answer),
            None if matches!(message, ServerMessage::VolumeChanged(_)) => self.answer = None,
            None => {}
        }
    }

    /// The server has answered.
    pub fn handle_answer(&mut self, answer: Q::Answer) {
        self.unanswered.take_if(|asked| asked.id() == Q::id_of(&answer));
        self.answer = Some(answer);
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        self.outbox.poll(now_micros).map(Q::to_message)
    }

    /// When to poll again, µs.
    pub fn due(&self) -> Option<u64> {
        self.outbox.due()
    }
}

/// The server's half: the newest question.
#[derive(Debug)]
pub struct InquiryServer<Q: Question> {
    asked: Option<Q>,
    /// The question that was answered last.
    answered: Option<Q>,
    answer: Option<Q::Answer>,
}

impl<Q: Question> Default for InquiryServer<Q> {
    fn default() -> Self {
        Self { asked: None, answered: None, answer: None }
    }
}

impl<Q: Question> InquiryServer<Q> {
    /// A message has arrived. Only the newest question remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        self.asked = Q::in_message(message).or(self.asked);
    }

    /// Whether a question waits for its answer.
    pub fn is_asked(&self) -> bool {
        self.asked.is_some()
    }

    /// Answers the question from the shown volume, and returns it.
    pub fn answer(&mut self, values: &mut dyn ValuesAt) -> Option<Q> {
        let question = self.take()?;
        self.answer = Some(question.answer_from(values));
        Some(question)
    }

    /// Takes the question, whose answer comes later.
    pub fn take(&mut self) -> Option<Q> {
        let question = self.asked.take()?;
        self.answered = Some(question);
        Some(question)
    }

    /// The answer to a question that was taken. It is sent even if another was asked meanwhile, so that something is seen
    /// while questions come faster than answers.
    pub fn handle_answer(&mut self, answer: Q::Answer) {
        self.answer = Some(answer);
    }

    /// Finer values are there. They are sent if nothing else was asked meanwhile, and the volume is the same.
    pub fn handle_finer(&mut self, question: &Q, answer: Q::Answer) {
        if self.asked.is_none() && self.answered.as_ref() == Some(question) {
            self.answer = Some(answer);
        }
    }

    /// Another volume is shown. An answer that is not sent yet is looked up again.
    pub fn handle_volume(&mut self) {
        let unsent = self.answered.take().filter(|_| self.answer.is_some());
        (self.asked, self.answer) = (self.asked.or(unsent), None);
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        self.answer.take().map(Q::message_of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::probe::ProbeServer;
    use crate::volume::Volume;
    use crate::volume::procedural::Builtin;
    use crate::wire::ProbeRequest;

    fn ask(server: &mut ProbeServer, id: u32, x: f32) -> ProbeRequest {
        let question = ProbeRequest { id: ProbeId(id), point: [x, 0.0, 0.0] };
        server.handle_message(&question.to_message());
        question
    }

    fn told(server: &mut ProbeServer) -> Option<(ProbeId, f32)> {
        let answer = ProbeRequest::answer_in(&server.poll_message()?)?;
        Some((answer.id, answer.point[0]))
    }

    #[test]
    fn finer_values_go_out_for_the_question_and_the_volume_that_they_are_of() {
        let volume: &Volume = &Builtin::Shells.volume(16);
        let mut server = ProbeServer::default();
        let first = ask(&mut server, 5, 0.1);
        assert_eq!(server.answer(&mut &*volume), Some(first));
        let finer = |question: &ProbeRequest| question.answer_from(&mut &*volume);
        assert!(told(&mut server).is_some());
        server.handle_finer(&first, finer(&first));
        assert_eq!(told(&mut server), Some((ProbeId(5), 0.1)), "the control");
        // The same number, but another point.
        let second = ask(&mut server, 5, 0.2);
        server.handle_finer(&first, finer(&first));
        assert_eq!(told(&mut server), None, "something else is asked");
        server.answer(&mut &*volume);
        assert_eq!(told(&mut server), Some((ProbeId(5), 0.2)));
        server.handle_finer(&first, finer(&first));
        assert_eq!(told(&mut server), None, "it is of an older question");
        // The same question, but another volume.
        server.handle_volume();
        server.handle_finer(&second, finer(&second));
        assert_eq!((told(&mut server), server.is_asked()), (None, false));
        // An answer that was not sent is one of the new volume.
        let third = ask(&mut server, 6, 0.3);
        server.answer(&mut &*volume);
        server.handle_volume();
        assert_eq!(told(&mut server), None);
        assert_eq!(server.answer(&mut &*volume), Some(third));
        assert_eq!(told(&mut server), Some((ProbeId(6), 0.3)));
    }
}
