// Two segments of a medium as one.

fn united(segment: OpenSegment, behind: OpenSegment) -> OpenSegment {
    return appended(segment, behind);
}
