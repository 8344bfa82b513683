//! Restores what is lost of a frame's stream without a round trip.
//!
//! A stream repeats lost packets, but that takes a round trip, and a frame is old by then. On a link that loses
//! packets the server therefore sends *parity* behind each frame of a moving camera: as much as makes a repair very
//! likely at the loss of the last seconds. The viewer restores the missing bytes from it and stops the stream.
//! Whatever cannot be restored still comes by the stream.

use reed_solomon_simd::{ReedSolomonDecoder, ReedSolomonEncoder};

use crate::wire::parity::{MAX_REPAIRED_BYTES, MAX_SYMBOLS, PARITY_HEAD_BYTES, ParityHead};

/// The datagrams with the parity of a stream's bytes, for a link that loses `loss` of its packets of about
/// `packet_bytes`. None for a link that loses hardly any, and for a stream that is too long.
pub fn parity(stream: u64, bytes: &[u8], loss: f64, packet_bytes: usize) -> Vec<Vec<u8>> {
    if loss < LEAST_LOSS || bytes.is_empty() || bytes.len() > MAX_REPAIRED_BYTES {
        return vec![];
    }
    let symbol_bytes = symbol_bytes(bytes.len());
    let per_datagram = packet_bytes.saturating_sub(PARITY_HEAD_BYTES) / symbol_bytes;
    if per_datagram == 0 {
        return vec![];
    }
    let num_parity = num_parity(bytes.len(), loss, packet_bytes);
    let Some(symbols) = encode(bytes, symbol_bytes, num_parity) else { return vec![] };
    let datagram = |(i, part): (usize, &[u8])| {
        let head = ParityHead {
            stream_bytes: bytes.len() as u32,
            stream,
            symbol_bytes: symbol_bytes as u16,
            num_parity: num_parity as u16,
            first: (i * per_datagram) as u16,
        };
        [&head.encode()[..], part].concat()
    };
    symbols.chunks(per_datagram * symbol_bytes).enumerate().map(datagram).collect()
}

/// Bytes of parity for each byte of a stream.
pub fn overhead(num_bytes: usize, loss: f64, packet_bytes: usize) -> f64 {
    if loss < LEAST_LOSS || num_bytes > MAX_REPAIRED_BYTES {
        return 0.0;
    }
    (num_parity(num_bytes, loss, packet_bytes) * symbol_bytes(num_bytes)) as f64 / num_bytes.max(1) as f64
}

/// Small, because a lost packet costs a symbol at each of its ends.
fn symbol_bytes(num_bytes: usize) -> usize {
    (num_bytes.div_ceil(MAX_SYMBOLS / 4)).next_multiple_of(2).max(LEAST_SYMBOL_BYTES)
}

/// So many that losses exceed them once in [`FRAMES_A_FAILURE`] frames: later frames may be predicted from one that
/// fails, and wait for it.
fn num_parity(num_bytes: usize, loss: f64, packet_bytes: usize) -> usize {
    let loss = loss.min(MAX_LOSS);
    // The parity's own packets are lost as well.
    let packets = (num_bytes as f64 / packet_bytes.max(1) as f64).ceil() * (1.0 + 2.0 * loss) + 1.0;
    // Few of many packets: the number of losses has Poisson's distribution.
    let mean = packets * loss;
    let (mut lost, mut probability) = (0, (-mean).exp());
    let mut more = 1.0 - probability;
    while more > 1.0 / FRAMES_A_FAILURE {
        lost += 1;
        probability *= mean / f64::from(lost);
        more -= probability;
    }
    let per_packet = packet_bytes / symbol_bytes(num_bytes) + 2;
    (lost as usize * per_packet).min(MAX_SYMBOLS)
}

fn encode(bytes: &[u8], symbol_bytes: usize, num_parity: usize) -> Option<Vec<u8>> {
    let num_original = bytes.len().div_ceil(symbol_bytes);
    let mut encoder = ReedSolomonEncoder::new(num_original, num_parity, symbol_bytes).ok()?;
    let (whole, rest) = bytes.split_at(bytes.len() / symbol_bytes * symbol_bytes);
    for symbol in whole.chunks_exact(symbol_bytes) {
        encoder.add_original_shard(symbol).ok()?;
    }
    if !rest.is_empty() {
        let mut padded = rest.to_vec();
        padded.resize(symbol_bytes, 0);
        encoder.add_original_shard(padded).ok()?;
    }
    let encoded = encoder.encode().ok()?;
    Some(encoded.recovery_iter().flatten().copied().collect())
}

/// A stream whose parts arrive in any order, with the parity of its bytes. Times are µs.
#[derive(Debug, Default)]
pub struct RepairedStream {
    bytes: Vec<u8>,
    /// What is there, in order, without touching parts.
    present: Vec<(usize, usize)>,
    parity: Option<Parity>,
    /// When the last part or parity came.
    heard_at: u64,
}

#[derive(Debug)]
struct Parity {
    head: ParityHead,
    /// Each with its index, without repetition.
    symbols: Vec<(u16, Vec<u8>)>,
}

impl RepairedStream {
    /// Takes a part of the stream.
    pub fn handle_part(&mut self, now_micros: u64, offset: usize, part: &[u8]) {
        self.heard_at = now_micros;
        let end = offset + part.len();
        if self.bytes.len() < end {
            self.bytes.resize(end, 0);
        }
        self.bytes[offset..end].copy_from_slice(part);
        self.note_present(offset, end);
    }

    fn note_present(&mut self, start: usize, end: usize) {
        let first = self.present.partition_point(|part| part.1 < start);
        let last = self.present.partition_point(|part| part.0 <= end);
        let joined = self.present[first..last].iter().fold((start, end), |a, b| (a.0.min(b.0), a.1.max(b.1)));
        self.present.splice(first..last, [joined]);
    }

    /// The bytes from the start to the first gap.
    pub fn prefix(&self) -> &[u8] {
        match self.present.first() {
            Some(&(0, end)) => &self.bytes[..end],
            _ => &[],
        }
    }

    /// The bytes so far, with gaps.
    pub fn num_bytes(&self) -> usize {
        self.bytes.len()
    }

    /// All bytes. Call it at the end of the stream, or after a repair.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Takes a parity datagram of this stream. One that contradicts earlier ones is ignored.
    pub fn handle_parity(&mut self, now_micros: u64, head: ParityHead, symbols: &[u8]) {
        self.heard_at = now_micros;
        let parity = self.parity.get_or_insert_with(|| Parity { head, symbols: vec![] });
        if (ParityHead { first: parity.head.first, ..head }) != parity.head {
            return;
        }
        for (i, symbol) in symbols.chunks_exact(usize::from(head.symbol_bytes)).enumerate() {
            let index = head.first.saturating_add(i as u16);
            let is_new = parity.symbols.iter().all(|(known, _)| *known != index);
            // More than the stream has itself is never needed.
            if is_new && parity.symbols.len() < head.num_original() {
                parity.symbols.push((index, symbol.to_vec()));
            }
        }
    }

    /// When to call [`Self::repair`], if nothing more comes. `None` while the parity is not enough.
    pub fn repair_due(&self) -> Option<u64> {
        let parity = self.parity.as_ref()?;
        let missing = self.num_missing(&parity.head);
        // Without a gap in it, the end may just be on its way.
        let wait = if self.present.len() > 1 { 0 } else { TAIL_MICROS };
        (missing > 0 && missing <= parity.symbols.len()).then_some(self.heard_at + wait)
    }

    /// Restores what is missing. Returns whether the stream is whole now.
    pub fn repair(&mut self) -> bool {
        let Some(Parity { head, symbols }) = self.parity.take() else { return false };
        let (size, total) = (usize::from(head.symbol_bytes), head.stream_bytes as usize);
        if self.bytes.len() > total {
            return false;
        }
        self.bytes.resize(total, 0);
        let restored = self.restored(&head, &symbols);
        let Some(restored) = restored else { return false };
        let starts = [0].into_iter().chain(self.present.iter().map(|part| part.1));
        let ends = self.present.iter().map(|part| part.0).chain([total]);
        let gaps: Vec<_> = starts.zip(ends).collect();
        for (index, symbol) in restored {
            let start = index * size;
            for &(from, to) in &gaps {
                let (from, to) = (from.max(start), to.min(start + size));
                if from < to {
                    self.bytes[from..to].copy_from_slice(&symbol[from - start..to - start]);
                }
            }
        }
        self.present = vec![(0, total)];
        true
    }

    fn restored(&self, head: &ParityHead, parity: &[(u16, Vec<u8>)]) -> Option<Vec<(usize, Vec<u8>)>> {
        let (size, num) = (usize::from(head.symbol_bytes), head.num_original());
        let mut decoder = ReedSolomonDecoder::new(num, head.num_parity.into(), size).ok()?;
        let mut padded = vec![0; size];
        for index in (0..num).filter(|&i| self.has_symbol(head, i)) {
            let start = index * size;
            match self.bytes.get(start..start + size) {
                Some(symbol) => decoder.add_original_shard(index, symbol).ok()?,
                None => {
                    let rest = &self.bytes[start..];
                    padded[..rest.len()].copy_from_slice(rest);
                    decoder.add_original_shard(index, &padded).ok()?;
                }
            }
        }
        for (index, symbol) in parity {
            decoder.add_recovery_shard(usize::from(*index), symbol).ok()?;
        }
        let decoded = decoder.decode().ok()?;
        Some(decoded.restored_original_iter().map(|(index, symbol)| (index, symbol.to_vec())).collect())
    }

    /// Whether all bytes of an original symbol are there.
    fn has_symbol(&self, head: &ParityHead, index: usize) -> bool {
        let size = usize::from(head.symbol_bytes);
        let (start, end) = (index * size, ((index + 1) * size).min(head.stream_bytes as usize));
        let at = self.present.partition_point(|part| part.1 < end);
        self.present.get(at).is_some_and(|part| part.0 <= start && part.1 >= end)
    }

    fn num_missing(&self, head: &ParityHead) -> usize {
        let (size, total) = (usize::from(head.symbol_bytes), head.stream_bytes as usize);
        let mut missing = 0;
        let (mut from, mut counted) = (0, 0);
        // Two gaps may lie in one symbol.
        for &(start, end) in self.present.iter().chain(&[(total, total)]) {
            let start = start.min(total);
            if start > from {
                let (first, last) = ((from / size).max(counted), start.div_ceil(size));
                missing += last.saturating_sub(first);
                counted = last.max(counted);
            }
            from = from.max(end);
        }
        missing
    }
}

/// Below this share of lost packets, repeats are rare enough.
const LEAST_LOSS: f64 = 0.004;
/// Above it the link is full rather than lossy.
const MAX_LOSS: f64 = 0.1;
const FRAMES_A_FAILURE: f64 = 2000.0;
const LEAST_SYMBOL_BYTES: usize = 128;
/// How long the end of a stream may be on its way, although its parity is there, µs.
const TAIL_MICROS: u64 = 2_000;

#[cfg(test)]
mod tests {
    use super::*;

    const PACKET: usize = 1100;

    fn bytes(num: usize) -> Vec<u8> {
        (0..num as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 21) as u8).collect()
    }

    /// Receives the stream and its parity without the packets of these numbers; the parity's packets come last.
    fn receive(all: &[u8], parity: &[Vec<u8>], lost: impl Fn(usize) -> bool) -> RepairedStream {
        let mut stream = RepairedStream::default();
        let num_packets = all.len().div_ceil(PACKET);
        for (i, part) in all.chunks(PACKET).enumerate().filter(|(i, _)| !lost(*i)) {
            stream.handle_part(i as u64, i * PACKET, part);
        }
        for (_, datagram) in parity.iter().enumerate().filter(|(i, _)| !lost(num_packets + i)) {
            let (head, symbols) = ParityHead::decode(datagram).unwrap();
            stream.handle_parity(1000, head, symbols);
        }
        stream
    }

    #[test]
    fn lost_packets_are_restored_to_the_bit() {
        for num in [1, 127, 128, 5_000, 60_000, 400_000] {
            let all = bytes(num);
            let parity = parity(3, &all, 0.02, PACKET);
            for seed in 0..20usize {
                // Every 31st packet or so: more than the loss that is expected.
                let lost = |i: usize| {
                    num > PACKET && (i * 7 + seed).is_multiple_of(if num < 10_000 { 97 } else { 31 })
                };
                let mut stream = receive(&all, &parity, lost);
                let is_whole = stream.prefix().len() == num;
                assert_eq!(stream.repair_due().is_some(), !is_whole, "{num} {seed}");
                assert!(is_whole || stream.repair());
                assert_eq!(stream.into_bytes(), all);
            }
        }
    }

    #[test]
    fn too_many_losses_leave_it_to_the_stream() {
        let all = bytes(60_000);
        let parity = parity(3, &all, 0.02, PACKET);
        let mut stream = receive(&all, &parity, |i| i.is_multiple_of(3));
        assert_eq!(stream.repair_due(), None);
        // Repeats complete it.
        for (i, part) in all.chunks(PACKET).enumerate() {
            stream.handle_part(2000, i * PACKET, part);
        }
        assert_eq!((stream.prefix().len(), stream.repair_due()), (60_000, None));
        assert_eq!(stream.into_bytes(), all);
    }

    #[test]
    fn an_end_that_may_be_on_its_way_is_awaited() {
        let all = bytes(20_000);
        let parity = parity(3, &all, 0.05, PACKET);
        let tail = all.len().div_ceil(PACKET) - 1;
        let mut stream = receive(&all, &parity, |i| i == tail);
        assert_eq!(stream.repair_due(), Some(1000 + TAIL_MICROS));
        assert!(stream.repair());
        assert_eq!(stream.into_bytes(), all);
        assert_eq!(receive(&all, &parity, |i| i == tail - 3).repair_due(), Some(1000));
    }

    #[test]
    fn parity_fails_once_in_two_thousand_frames() {
        let mut random = 88_172_645_463_325_252u64;
        for (num, loss, most_overhead) in
            [(8_000, 0.02, 0.5), (40_000, 0.02, 0.25), (100_000, 0.02, 0.15), (100_000, 0.01, 0.1)]
        {
            let packets = num / PACKET + 1;
            let per_packet = (PACKET - PARITY_HEAD_BYTES) / 128;
            let parity_packets = num_parity(num, loss, PACKET).div_ceil(per_packet);
            let runs = 40_000;
            let mut failed = 0;
            for _ in 0..runs {
                let mut lost_of = |num: usize| {
                    (0..num)
                        .filter(|_| {
                            random ^= random << 13;
                            random ^= random >> 7;
                            random ^= random << 17;
                            ((random >> 11) as f64) < loss * (1u64 << 53) as f64
                        })
                        .count()
                };
                let (lost, lost_parity) = (lost_of(packets), lost_of(parity_packets));
                failed +=
                    usize::from(lost * (PACKET / 128 + 2) > (parity_packets - lost_parity) * per_packet);
            }
            let share = failed as f64 / f64::from(runs);
            assert!(share < 0.001, "{num} bytes at {loss}: {share} not repaired");
            assert!(overhead(num, loss, PACKET) < most_overhead, "{num}: {}", overhead(num, loss, PACKET));
            // Without parity most are not whole.
            assert!(1.0 - (1.0 - loss).powi(packets as i32) > 5.0 * share);
        }
        assert_eq!(overhead(100_000, 0.001, PACKET), 0.0);
        assert!(parity(1, &bytes(100), 0.001, PACKET).is_empty() && parity(1, &[], 0.02, PACKET).is_empty());
        assert!(parity(1, &bytes(MAX_REPAIRED_BYTES + 1), 0.02, PACKET).is_empty());
    }

    #[test]
    fn hostile_parity_neither_panics_nor_changes_what_is_there() {
        let all = bytes(10_000);
        let good = parity(3, &all, 0.05, PACKET);
        let mut random = 5u64;
        for round in 0..400 {
            let mut stream = RepairedStream::default();
            for (i, part) in all.chunks(PACKET).enumerate().filter(|(i, _)| i % 4 != 1) {
                stream.handle_part(0, i * PACKET, part);
            }
            for datagram in &good {
                let mut damaged = datagram.clone();
                random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                let at = (random >> 33) as usize % 22;
                damaged[at] ^= 1 << (round % 8);
                if let Ok((head, symbols)) = ParityHead::decode(&damaged) {
                    stream.handle_parity(0, head, symbols);
                }
            }
            let before = stream.prefix().to_vec();
            if stream.repair_due().is_some() {
                stream.repair();
            }
            assert_eq!(stream.prefix()[..before.len()], before);
        }
    }
}
