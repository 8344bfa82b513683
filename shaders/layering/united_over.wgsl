// Merges two segments of a medium.

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    return appended(segment, behind);
}
