//! Insertions and deletions in a source text that may nest, with the places of what was inserted.

/// Characters that no source has: `OPEN numbers NAMED text CLOSE` encloses what belongs to mutants.
const OPEN: char = '\u{1}';
const NAMED: char = '\u{2}';
const CLOSE: char = '\u{3}';

/// `text`, marked as that of some mutants.
pub fn marked(numbers: &[usize], text: &str) -> String {
    format!("{}{text}{CLOSE}", opened(numbers))
}

fn opened(numbers: &[usize]) -> String {
    let numbers: Vec<String> = numbers.iter().map(usize::to_string).collect();
    format!("{OPEN}{}{NAMED}", numbers.join(","))
}

/// Where edits at one position stand: ends of inner expressions before those of outer ones, then beginnings of outer
/// before inner.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Order {
    EndAtDepth(std::cmp::Reverse<usize>),
    Statement,
    BeginAtDepth(usize),
    Operator,
}

struct Edit {
    position: usize,
    order: Order,
    deleted: usize,
    text: String,
}

#[derive(Default)]
pub struct Edits(Vec<Edit>);

impl Edits {
    /// `before` and `after` around an expression of the mutants `numbers`; `depth` says how far inside others it is.
    pub fn wrap(&mut self, range: std::ops::Range<usize>, depth: usize, numbers: &[usize], before: &str, after: &str) {
        let before = opened(numbers) + before;
        let after = format!("{after}{CLOSE}");
        self.0.push(Edit { position: range.start, order: Order::BeginAtDepth(depth), deleted: 0, text: before });
        self.0.push(Edit {
            position: range.end,
            order: Order::EndAtDepth(std::cmp::Reverse(depth)),
            deleted: 0,
            text: after,
        });
    }

    /// A statement at the head of a function.
    pub fn insert(&mut self, position: usize, text: String) {
        self.0.push(Edit { position, order: Order::Statement, deleted: 0, text });
    }

    /// Another text in the place of an operator.
    pub fn replace(&mut self, range: std::ops::Range<usize>, text: String) {
        self.0.push(Edit { position: range.start, order: Order::Operator, deleted: range.len(), text });
    }

    /// The edited text, and the `place` lines of `file`.
    pub fn apply(mut self, file: &str, source: &str) -> (String, Vec<String>) {
        self.0.sort_by_key(|e| (e.position, e.order)); // stable: statements stay in their order
        let (mut marked, mut at) = (String::new(), 0);
        for edit in &self.0 {
            marked += &source[at..edit.position];
            marked += &edit.text;
            at = edit.position + edit.deleted;
        }
        marked += &source[at..];
        places(file, &marked)
    }
}

/// Takes the marks out.
fn places(file: &str, marked: &str) -> (String, Vec<String>) {
    let (mut text, mut lines, mut open) = (String::new(), Vec::new(), Vec::new());
    let mut characters = marked.chars();
    while let Some(c) = characters.next() {
        match c {
            OPEN => open.push((text.len(), characters.by_ref().take_while(|&c| c != NAMED).collect::<String>())),
            CLOSE => {
                let (start, numbers) = open.pop().expect("marks are nested");
                lines.push(format!("place\t{file}\t{start}\t{}\t{numbers}", text.len()));
            }
            _ => text.push(c),
        }
    }
    (text, lines)
}
