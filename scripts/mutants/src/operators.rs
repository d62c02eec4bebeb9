//! The mutation operators. docs/testing.md lists them.

use std::collections::HashSet;
use std::ops::Range;

use proc_macro2::Span;
use quote::ToTokens;
use syn::spanned::Spanned;
use syn::visit::{self, Visit};
use syn::*;

use crate::rewrite::{Edits, marked};

/// A rewritten file.
pub struct Planted {
    pub text: String,
    pub lines: Vec<String>,
}

/// Plants the mutants of a file; `count` is the number of the last one and goes on.
pub fn plant(file: &str, source: &str, dropped: &HashSet<String>, count: &mut usize) -> Result<Planted> {
    let tree = parse_file(source)?;
    let mut planter = Planter {
        source,
        file,
        dropped,
        count,
        edits: Edits::default(),
        depth: 0,
        lines: Vec::new(),
        functions: Vec::new(),
    };
    planter.visit_file(&tree);
    let mut lines = planter.lines;
    let (text, places) = planter.edits.apply(file, source);
    lines.extend(places);
    Ok(Planted { text, lines })
}

struct Planter<'a> {
    source: &'a str,
    file: &'a str,
    dropped: &'a HashSet<String>,
    count: &'a mut usize,
    edits: Edits,
    /// How many expressions with edits enclose the present one.
    depth: usize,
    lines: Vec<String>,
    functions: Vec<String>,
}

fn bytes(span: Span) -> Range<usize> {
    span.byte_range()
}

/// What a function may return instead of its value. Nothing for types that no value is known for.
fn return_values(signature: &Signature) -> &'static [&'static str] {
    let name = match &signature.output {
        ReturnType::Default => String::new(),
        ReturnType::Type(_, t) => t.to_token_stream().to_string().replace(' ', ""),
    };
    match name.as_str() {
        "" | "()" => &["()"],
        "bool" => &["true", "false"],
        "f64" | "f32" => &["0.0", "1.0", "-1.0"],
        "usize" | "u64" | "u32" => &["0", "1"],
        "String" => &["String::new()"],
        "Point" | "[f64;2]" => &["[0.0, 0.0]"],
        "Result<()>" | "Result<(),String>" | "Result<(),BoxedError>" | "std::io::Result<()>" => &["Ok(())"],
        _ if name.starts_with("Option<") => &["None"],
        _ if name.starts_with("Vec<") => &["Vec::new()"],
        _ => &[],
    }
}

fn replacements(operator: &str) -> &'static [&'static str] {
    match operator {
        "+" => &["-", "*"],
        "-" => &["+", "/"],
        "*" => &["+", "/"],
        "/" => &["%", "*"],
        "%" => &["/", "+"],
        "<" => &["==", ">", "<="],
        ">" => &["==", "<", ">="],
        "==" => &["!="],
        "!=" => &["=="],
        "<=" => &[">"],
        ">=" => &["<"],
        "<<" => &[">>"],
        ">>" => &["<<"],
        "&" => &["|", "^"],
        "|" => &["&", "^"],
        "^" => &["|", "&"],
        "&&" => &["||"],
        "||" => &["&&"],
        "+=" => &["-=", "*="],
        "-=" => &["+=", "/="],
        "*=" => &["+=", "/="],
        "/=" => &["*="],
        _ => &[],
    }
}

/// Whether a condition is (or has) a `let`, which cannot stand in a `match`.
fn has_let(condition: &Expr) -> bool {
    match condition {
        Expr::Let(_) => true,
        Expr::Binary(b) => has_let(&b.left) || has_let(&b.right),
        Expr::Paren(p) => has_let(&p.expr),
        _ => false,
    }
}

/// The index that replaces a literal index: the one before it; for 0, the next.
fn neighbour(index: usize) -> usize {
    if index == 0 { 1 } else { index - 1 }
}

impl Planter<'_> {
    /// The number of a mutant; none when it is one of those dropped.
    fn number(&mut self, span: Span, what: String) -> Option<usize> {
        let (line, column) = (span.start().line, span.start().column + 1);
        if self.dropped.contains(&format!("{}\t{line}\t{column}\t{what}", self.file)) {
            return None;
        }
        *self.count += 1;
        let function = self.functions.last().map_or("", String::as_str);
        self.lines.push(format!("mutant\t{}\t{}\t{line}\t{column}\t{what}\t{function}", self.count, self.file));
        Some(*self.count)
    }

    fn text(&self, span: Span) -> &str {
        &self.source[bytes(span)]
    }

    /// One of some texts in the place of an expression.
    fn one_of(&mut self, span: Span, others: &[(usize, String)], before: &str, after: &str) {
        let numbers: Vec<usize> = others.iter().map(|o| o.0).collect();
        let choices: String =
            others.iter().map(|(k, t)| marked(&[*k], &format!("if crate::mutant({k}) {{ {t} }} else "))).collect();
        self.edits.wrap(bytes(span), self.depth, &numbers, &format!("({before}{choices}{{ {after}"), " })");
    }

    /// A function returns at once; then what is inside.
    fn function(&mut self, signature: &Signature, block: &Block) {
        if signature.constness.is_some() {
            return;
        }
        self.functions.push(signature.ident.to_string());
        for value in return_values(signature) {
            if let Some(k) = self.number(signature.ident.span(), format!("return {value}")) {
                let statement = marked(&[k], &format!(" if crate::mutant({k}) {{ return {value}; }} "));
                self.edits.insert(bytes(block.span()).start + 1, statement);
            }
        }
        self.visit_block(block);
        self.functions.pop();
    }

    fn binary(&mut self, e: &ExprBinary) {
        let operator = e.op.to_token_stream().to_string();
        if has_let(&e.left) || has_let(&e.right) {
            return;
        }
        let mutants: Vec<(usize, &str)> = replacements(&operator)
            .iter()
            .filter_map(|r| Some((self.number(e.op.span(), format!("{operator} to {r}"))?, *r)))
            .collect();
        if mutants.is_empty() {
            return;
        }
        let numbers: Vec<usize> = mutants.iter().map(|m| m.0).collect();
        let (whole, place) = (bytes(e.span()), bytes(e.op.span()));
        let choices = |expression: &dyn Fn(&str) -> String| -> String {
            let one =
                |(k, r): &(usize, &str)| marked(&[*k], &format!("if crate::mutant({k}) {{ {} }} else ", expression(r)));
            mutants.iter().map(one).collect()
        };
        match operator.as_str() {
            // The right side is only evaluated when the left decides nothing.
            "&&" | "||" => {
                let same = if operator == "&&" { "==" } else { "!=" };
                let k = numbers[0];
                self.edits.wrap(whole, self.depth, &numbers, "(match ", " } })");
                self.edits.replace(place, format!(" {{ l => if l {same} crate::mutant({k}) {{ l }} else {{ "));
            }
            "+=" | "-=" | "*=" | "/=" => {
                let (left, right) = (self.text(e.left.span()), self.text(e.right.span()));
                let before = format!("{{ {}{{ ", choices(&|r| format!("{left} {r} {right};")));
                self.edits.wrap(whole, self.depth, &numbers, &before, "; } }");
            }
            // Comparisons take their sides by reference, as the operator does.
            "<" | ">" | "==" | "!=" | "<=" | ">=" => {
                let after = format!(")) {{ (l, r) => {}{{ *l {operator} *r }} }})", choices(&|r| format!("*l {r} *r")));
                self.edits.wrap(whole, self.depth, &numbers, "(match (&(", &after);
                self.edits.replace(place, "), &(".to_string());
            }
            _ => {
                let after = format!(") {{ (l, r) => {}{{ l {operator} r }} }})", choices(&|r| format!("l {r} r")));
                self.edits.wrap(whole, self.depth, &numbers, "(match (", &after);
                self.edits.replace(place, ",".to_string());
            }
        }
    }
}

impl<'ast> Visit<'ast> for Planter<'_> {
    fn visit_item_mod(&mut self, module: &'ast ItemMod) {
        if !module.attrs.iter().any(|a| a.to_token_stream().to_string().contains("test")) {
            visit::visit_item_mod(self, module);
        }
    }

    fn visit_item_const(&mut self, _: &'ast ItemConst) {}
    fn visit_item_static(&mut self, _: &'ast ItemStatic) {}
    fn visit_impl_item_const(&mut self, _: &'ast ImplItemConst) {}
    fn visit_trait_item_const(&mut self, _: &'ast TraitItemConst) {}
    fn visit_type(&mut self, _: &'ast Type) {}
    fn visit_pat(&mut self, _: &'ast Pat) {}
    fn visit_generic_argument(&mut self, _: &'ast GenericArgument) {}
    fn visit_attribute(&mut self, _: &'ast Attribute) {}
    fn visit_expr_const(&mut self, _: &'ast ExprConst) {}

    fn visit_expr_repeat(&mut self, e: &'ast ExprRepeat) {
        self.visit_expr(&e.expr); // the length is a constant
    }

    fn visit_item_fn(&mut self, f: &'ast ItemFn) {
        self.function(&f.sig, &f.block);
    }

    fn visit_impl_item_fn(&mut self, f: &'ast ImplItemFn) {
        self.function(&f.sig, &f.block);
    }

    fn visit_expr_unary(&mut self, e: &'ast ExprUnary) {
        self.depth += 1;
        let operator = match e.op {
            UnOp::Neg(_) => "-",
            UnOp::Not(_) => "!",
            _ => "",
        };
        if !operator.is_empty()
            && !has_let(&e.expr)
            && let Some(k) = self.number(e.op.span(), format!("without {operator}"))
        {
            let after = format!(" {{ v => if crate::mutant({k}) {{ v }} else {{ {operator}v }} }})");
            self.edits.wrap(bytes(e.span()), self.depth, &[k], "(match ", &after);
            self.edits.replace(bytes(e.op.span()), String::new());
        }
        // A literal with its sign: the sign alone is the mutant above.
        if let (UnOp::Neg(_), Expr::Lit(ExprLit { lit: Lit::Float(literal), .. })) = (e.op, &*e.expr) {
            self.float(literal, false);
        } else {
            visit::visit_expr_unary(self, e);
        }
        self.depth -= 1;
    }

    fn visit_expr_binary(&mut self, e: &'ast ExprBinary) {
        self.depth += 1;
        self.binary(e);
        visit::visit_expr_binary(self, e);
        self.depth -= 1;
    }

    fn visit_expr_lit(&mut self, e: &'ast ExprLit) {
        if let Lit::Float(literal) = &e.lit {
            self.float(literal, true);
        }
    }

    fn visit_expr_index(&mut self, e: &'ast ExprIndex) {
        self.visit_expr(&e.expr);
        match &*e.index {
            Expr::Lit(ExprLit { lit: Lit::Int(literal), .. }) => {
                let Ok(index) = literal.base10_parse::<usize>() else { return };
                let other = neighbour(index);
                self.depth += 1;
                if let Some(k) = self.number(literal.span(), format!("[{index}] to [{other}]")) {
                    self.one_of(literal.span(), &[(k, format!("{other}{}", literal.suffix()))], "", "");
                }
                self.depth -= 1;
            }
            index => self.visit_expr(index),
        }
    }

    fn visit_expr_field(&mut self, e: &'ast ExprField) {
        self.depth += 1;
        if let Member::Unnamed(index) = &e.member
            && index.index < 2
        {
            let other = 1 - index.index;
            if let Some(k) = self.number(index.span, format!(".{} to .{other}", index.index)) {
                // A place, so that what is borrowed stays borrowed. What would move or be assigned to does not compile.
                let swapped = format!("&{}.{other}", self.text(e.base.span()));
                self.one_of(e.span(), &[(k, swapped)], "*", "&");
            }
        }
        visit::visit_expr_field(self, e);
        self.depth -= 1;
    }
}

impl Planter<'_> {
    /// A floating literal half as large again, and with the other sign; one in the place of zero.
    fn float(&mut self, literal: &LitFloat, signed: bool) {
        let Ok(value) = literal.base10_parse::<f64>() else { return };
        let mut others = if value == 0.0 { vec![1.0] } else { vec![1.5 * value] };
        if signed && value != 0.0 {
            others.push(-value);
        }
        self.depth += 1;
        let others: Vec<(usize, String)> = others
            .into_iter()
            .filter_map(|other| {
                let text = format!("{other:?}{}", literal.suffix());
                Some((self.number(literal.span(), format!("{literal} to {text}"))?, text))
            })
            .collect();
        if !others.is_empty() {
            self.one_of(literal.span(), &others, "", "");
        }
        self.depth -= 1;
    }
}
