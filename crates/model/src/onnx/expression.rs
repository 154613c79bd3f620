//! Expressions over the rows of a batch, which become the nodes of an ONNX graph.
//!
//! Every value is a matrix of float64 with one row per box; arithmetic is by element, and a matrix of one column
//! is repeated over the columns of the other operand, as ONNX broadcasts.

use std::cell::RefCell;
use std::collections::HashSet;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::messages::{AttributeProto, DOUBLE, GraphProto, INT, INT64, NodeProto, TensorProto};

/// A graph under construction.
#[derive(Debug, Default)]
pub(crate) struct Graph(RefCell<Parts>);

#[derive(Debug, Default)]
struct Parts {
    nodes: Vec<NodeProto>,
    constants: Vec<TensorProto>,
}

/// A value of a graph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Expr<'g> {
    graph: &'g Graph,
    name: Name,
}

/// How the values of a graph are called.
#[derive(Debug, Clone, Copy)]
enum Name {
    Input(&'static str),
    Constant(usize),
    Node(usize),
}

/// A condition, by element.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Condition<'g>(Expr<'g>);

/// A value or a number.
pub(crate) trait Operand<'g> {
    fn on(self, graph: &'g Graph) -> Expr<'g>;
}

impl<'g> Operand<'g> for Expr<'g> {
    fn on(self, _: &'g Graph) -> Expr<'g> {
        self
    }
}

impl<'g> Operand<'g> for f64 {
    fn on(self, graph: &'g Graph) -> Expr<'g> {
        graph.constant(&[], &[self])
    }
}

impl std::fmt::Display for Name {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Input(name) => formatter.write_str(name),
            Self::Constant(at) => write!(formatter, "constant_{at}"),
            Self::Node(at) => write!(formatter, "value_{at}"),
        }
    }
}

impl Graph {
    /// The input of that name.
    pub(crate) const fn input(&self, name: &'static str) -> Expr<'_> {
        Expr { graph: self, name: Name::Input(name) }
    }

    /// A constant of that shape, row by row.
    pub(crate) fn constant(&self, shape: &[usize], numbers: &[f64]) -> Expr<'_> {
        debug_assert_eq!(shape.iter().product::<usize>(), numbers.len(), "numbers and shape must agree");
        let bytes = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.tensor(shape, DOUBLE, bytes)
    }

    /// A constant of one row.
    pub(crate) fn row(&self, numbers: &[f64]) -> Expr<'_> {
        self.constant(&[1, numbers.len()], numbers)
    }

    fn integers(&self, numbers: &[usize]) -> Expr<'_> {
        let bytes = numbers.iter().flat_map(|number| (*number as i64).to_le_bytes()).collect();
        self.tensor(&[numbers.len()], INT64, bytes)
    }

    /// Equal constants are stored once.
    fn tensor(&self, shape: &[usize], data_type: i32, raw_data: Vec<u8>) -> Expr<'_> {
        let dims: Vec<i64> = shape.iter().map(|extent| *extent as i64).collect();
        let constants = &mut self.0.borrow_mut().constants;
        let same =
            |own: &TensorProto| own.data_type == data_type && own.dims == dims && own.raw_data == raw_data;
        let at = constants.iter().position(same).unwrap_or_else(|| {
            let name = Name::Constant(constants.len()).to_string();
            constants.push(TensorProto { dims, data_type, name, raw_data });
            constants.len() - 1
        });
        Expr { graph: self, name: Name::Constant(at) }
    }

    fn node(&self, operator: &str, inputs: &[Expr<'_>], attributes: &[(&str, i64)]) -> Expr<'_> {
        let nodes = &mut self.0.borrow_mut().nodes;
        let name = Name::Node(nodes.len());
        let attribute =
            |(name, i): &(&str, i64)| AttributeProto { name: (*name).to_owned(), i: *i, r#type: INT };
        nodes.push(NodeProto {
            input: inputs.iter().map(|input| input.name.to_string()).collect(),
            output: vec![name.to_string()],
            op_type: operator.to_owned(),
            attribute: attributes.iter().map(attribute).collect(),
        });
        Expr { graph: self, name }
    }

    /// The columns of some values side by side.
    pub(crate) fn columns<'g>(&'g self, values: &[Expr<'g>]) -> Expr<'g> {
        self.node("Concat", values, &[("axis", 1)])
    }

    /// Names the value of an output.
    pub(crate) fn output(&self, value: Expr<'_>, name: &str) {
        self.node("Identity", &[value], &[]);
        if let Some(node) = self.0.borrow_mut().nodes.last_mut() {
            node.output = vec![name.to_owned()];
        }
    }

    /// The nodes and constants that the outputs of these names need, without name, inputs and outputs of the graph.
    pub(super) fn finish(self, outputs: &[&str]) -> GraphProto {
        let Parts { nodes, constants } = self.0.into_inner();
        let mut needed: HashSet<String> = outputs.iter().map(|name| (*name).to_owned()).collect();
        let mut kept: Vec<NodeProto> = Vec::with_capacity(nodes.len());
        for node in nodes.into_iter().rev() {
            if node.output.iter().any(|name| needed.contains(name)) {
                needed.extend(node.input.iter().cloned());
                kept.push(node);
            }
        }
        kept.reverse();
        let initializer = constants.into_iter().filter(|tensor| needed.contains(&tensor.name)).collect();
        GraphProto { node: kept, initializer, ..GraphProto::default() }
    }
}

impl<'g> Expr<'g> {
    fn unary(self, operator: &str) -> Self {
        self.graph.node(operator, &[self], &[])
    }

    fn binary(self, operator: &str, other: impl Operand<'g>) -> Self {
        self.graph.node(operator, &[self, other.on(self.graph)], &[])
    }

    /// The graph that it is part of.
    pub(crate) const fn graph(self) -> &'g Graph {
        self.graph
    }

    pub(crate) fn max(self, other: impl Operand<'g>) -> Self {
        self.binary("Max", other)
    }

    pub(crate) fn min(self, other: impl Operand<'g>) -> Self {
        self.binary("Min", other)
    }

    pub(crate) fn clamp(self, low: f64, high: f64) -> Self {
        self.max(low).min(high)
    }

    /// The positive part.
    pub(crate) fn positive(self) -> Self {
        self.max(0.0)
    }

    pub(crate) fn exp(self) -> Self {
        self.unary("Exp")
    }

    pub(crate) fn ln(self) -> Self {
        self.unary("Log")
    }

    pub(crate) fn sqrt(self) -> Self {
        self.unary("Sqrt")
    }

    pub(crate) fn tanh(self) -> Self {
        self.unary("Tanh")
    }

    pub(crate) fn sin(self) -> Self {
        self.unary("Sin")
    }

    pub(crate) fn cos(self) -> Self {
        self.unary("Cos")
    }

    pub(crate) fn square(self) -> Self {
        self * self
    }

    /// The product with a constant matrix, row by row.
    pub(crate) fn matrix_product(self, rows: usize, columns: usize, numbers: &[f64]) -> Self {
        self.binary("MatMul", self.graph.constant(&[rows, columns], numbers))
    }

    /// The sum over the columns of each row, as one column.
    pub(crate) fn sum(self) -> Self {
        self.graph.node("ReduceSum", &[self, self.graph.integers(&[1])], &[("keepdims", 1)])
    }

    /// The smallest number of each row, as one column.
    pub(crate) fn least(self) -> Self {
        self.graph.node("ReduceMin", &[self, self.graph.integers(&[1])], &[("keepdims", 1)])
    }

    /// One column.
    pub(crate) fn column(self, at: usize) -> Self {
        self.graph.node("Gather", &[self, self.graph.integers(&[at])], &[("axis", 1)])
    }

    /// The first columns, one by one.
    pub(crate) fn split<const N: usize>(self) -> [Self; N] {
        std::array::from_fn(|at| self.column(at))
    }

    /// The row of a table (`width` numbers each) at the index of the least column of each row.
    pub(crate) fn row_of_least(self, width: usize, table: &[f64]) -> Self {
        let least = self.graph.node("ArgMin", &[self], &[("axis", 1), ("keepdims", 0)]);
        let table = self.graph.constant(&[table.len() / width, width], table);
        self.graph.node("Gather", &[table, least], &[("axis", 0)])
    }

    pub(crate) fn exceeds(self, other: impl Operand<'g>) -> Condition<'g> {
        Condition(self.binary("Greater", other))
    }
}

impl<'g> Condition<'g> {
    /// One value where the condition holds, another elsewhere.
    pub(crate) fn choose(self, then: impl Operand<'g>, otherwise: impl Operand<'g>) -> Expr<'g> {
        let graph = self.0.graph;
        graph.node("Where", &[self.0, then.on(graph), otherwise.on(graph)], &[])
    }
}

impl Neg for Expr<'_> {
    type Output = Self;

    fn neg(self) -> Self {
        self.unary("Neg")
    }
}

macro_rules! arithmetic {
    ($($operation:ident, $method:ident, $operator:literal;)*) => {$(
        impl<'g, T: Operand<'g>> $operation<T> for Expr<'g> {
            type Output = Self;

            fn $method(self, other: T) -> Self {
                self.binary($operator, other)
            }
        }

        impl<'g> $operation<Expr<'g>> for f64 {
            type Output = Expr<'g>;

            fn $method(self, other: Expr<'g>) -> Expr<'g> {
                self.on(other.graph).binary($operator, other)
            }
        }
    )*};
}

arithmetic! {
    Add, add, "Add";
    Sub, sub, "Sub";
    Mul, mul, "Mul";
    Div, div, "Div";
}
