//! The recipe `gaussian_process`: the mixture of its maps with their covariance, and the test of a box's
//! plausibility. The formulas are those of `predictor.rs` for a box alone.

use super::box_plausibility::{BoxPlausibility, MAX_LOG_SIDE};
use super::kernel::SQRT_5;
use super::predictor::{
    CoefficientDeviation, PositionMap, Predictor, QUANTILES, SHRINKAGE, UNEXPLAINED_SHARE,
};
use super::projective_mean::{COEFFICIENTS, MAX_SIDE, MIN_DENOMINATOR, ProjectiveMean};
use crate::encoder::auto_encoder::AutoEncoder;
use crate::onnx::answer::{Answer, GraphContext};
use crate::onnx::boxes::{Boxes, reconstruction_error};
use crate::onnx::expression::Expr;
use crate::onnx::network;
use crate::onnx::plane::{self, piecewise_linear};

/// Numbers of a cell in a table: centre 2, coefficients 6, whitening 3, leverage 6.
const CELL_NUMBERS: usize = 17;

/// Foot u, foot v, width and height, px.
type Sides<'g> = [Expr<'g>; 4];
/// East, cross, north, m2.
type Covariance<'g> = [Expr<'g>; 3];

/// The answer of an encoder.
pub(super) fn express<'g>(
    predictor: &Predictor,
    auto_encoder: Option<&AutoEncoder>,
    context: &GraphContext<'_, 'g>,
) -> Answer<'g> {
    let boxes = context.boxes;
    let estimate = estimate(predictor, boxes);
    let reconstruction_px = match auto_encoder {
        Some(auto_encoder) => network::auto_encoder(auto_encoder, boxes).1,
        None => context.graph().columns(&estimate.plausible_px),
    };
    Answer {
        position_m: estimate.position_m,
        position_deg: plane::to_position(context.plane, estimate.position_m),
        covariance_m2: estimate.covariance_m2,
        r95_scale: estimate.r95_scale,
        reconstruction_error: reconstruction_error(boxes.features(), reconstruction_px),
    }
}

/// The answer for a box.
#[derive(Debug, Clone, Copy)]
struct MapEstimate<'g> {
    /// East and north, m.
    position_m: [Expr<'g>; 2],
    covariance_m2: Covariance<'g>,
    /// The 95 % radius in standard deviations per axis.
    r95_scale: Expr<'g>,
    /// The plausible box's features, px.
    plausible_px: Sides<'g>,
}

fn estimate<'g>(predictor: &Predictor, boxes: Boxes<'g>) -> MapEstimate<'g> {
    let sides = boxes.features();
    let Mixture { position_m, map_m2, by_edge } = mix(predictor, sides);
    let noise_m2 = quadratic(by_edge, &predictor.edge_px2);
    let mut covariance_m2: Covariance<'g> =
        std::array::from_fn(|at| map_m2[at] * predictor.widening + noise_m2[at]);
    covariance_m2[0] = covariance_m2[0] + predictor.shared_bias_m2;
    covariance_m2[2] = covariance_m2[2] + predictor.shared_bias_m2;
    let deviation = deviation(&predictor.plausibility, sides);
    let plausible_px = nearest_plausible(&predictor.plausibility, sides, &deviation);
    let other_m = mix(predictor, plausible_px).position_m;
    let moved_m = [0, 1].map(|axis| (other_m[axis] - position_m[axis]) * deviation.weight * SHRINKAGE);
    covariance_m2 = with_outer(covariance_m2, moved_m, None);
    let (own_edges, plausible_edges) = (edges_px(sides), edges_px(plausible_px));
    let square = |edge: usize| (plausible_edges[edge] - own_edges[edge]).square();
    let moved_px2 = (1..4).fold(square(0), |sum, edge| sum + square(edge)) / 4.0;
    let factor = deviation.weight * moved_px2 * UNEXPLAINED_SHARE;
    for (&east, &north) in by_edge[0].iter().zip(&by_edge[1]) {
        covariance_m2 = with_outer(covariance_m2, [east, north], Some(factor));
    }
    MapEstimate {
        position_m: [0, 1].map(|axis| position_m[axis] + moved_m[axis]),
        covariance_m2,
        r95_scale: r95_scale(predictor, covariance_m2),
        plausible_px,
    }
}

fn r95_scale<'g>(predictor: &Predictor, [east_m2, cross_m2, north_m2]: Covariance<'g>) -> Expr<'g> {
    let trace = east_m2 + north_m2;
    let squares = east_m2.square() + cross_m2.square() * 2.0 + north_m2.square();
    let at = (trace.square() / squares.max(1e-300) - 1.0).clamp(0.0, 1.0) * (QUANTILES - 1) as f64;
    (piecewise_linear(at, &predictor.quantiles) * 2.0).sqrt()
}

fn edges_px([u, v, width, height]: Sides<'_>) -> Sides<'_> {
    [u - width * 0.5, v - height, u + width * 0.5, v]
}

/// The mixture of all maps for a box.
struct Mixture<'g> {
    position_m: [Expr<'g>; 2],
    map_m2: Covariance<'g>,
    /// Derivatives by left, top, right, bottom, m per px.
    by_edge: [Sides<'g>; 2],
}

fn mix<'g>(predictor: &Predictor, sides: Sides<'g>) -> Mixture<'g> {
    let graph = sides[0].graph();
    let zero = graph.row(&[0.0]);
    let (mut mean_m, mut second_m2, mut jacobian) = ([zero; 2], [zero; 3], [[zero; 4]; 2]);
    let mut first_m = None;
    for map in &predictor.maps {
        let terms = terms(map, predictor, sides);
        let origin_m = *first_m.get_or_insert(terms.position_m);
        let from_first_m: [Expr<'g>; 2] = [0, 1].map(|axis| terms.position_m[axis] - origin_m[axis]);
        mean_m = [0, 1].map(|axis| mean_m[axis] + from_first_m[axis] * map.weight);
        let covariance_m2 = covariance_m2(map, &terms);
        second_m2 = std::array::from_fn(|at| second_m2[at] + covariance_m2[at] * map.weight);
        second_m2 = with_outer(second_m2, from_first_m, Some(graph.row(&[map.weight])));
        jacobian = std::array::from_fn(|axis| {
            std::array::from_fn(|side| jacobian[axis][side] + terms.jacobian[axis][side] * map.weight)
        });
    }
    let map_m2 = with_outer(second_m2, mean_m, Some(graph.row(&[-1.0])));
    let origin_m = first_m.unwrap_or([zero; 2]);
    let by_edge =
        jacobian.map(|[u, v, width, height]| [u * 0.5 - width, -height, u * 0.5 + width, v + height]);
    Mixture { position_m: [0, 1].map(|axis| origin_m[axis] + mean_m[axis]), map_m2, by_edge }
}

/// The terms of one map for a box.
struct MapTerms<'g> {
    tangent: [Expr<'g>; 2],
    /// In the directions of the kernel's weights; missing without a kernel.
    q: Option<Expr<'g>>,
    position_m: [Expr<'g>; 2],
    /// Derivatives by foot u, foot v, width, height, m per px.
    jacobian: [Sides<'g>; 2],
}

fn terms<'g>(map: &PositionMap, predictor: &Predictor, sides: Sides<'g>) -> MapTerms<'g> {
    let mean = MeanTerms::of(&map.mean, sides);
    let tangent = mean.tangent();
    let moved_m = tangent.map(|tangent| tangent.matrix_product(COEFFICIENTS, 1, &map.step));
    let mut jacobian = mean.jacobian(map, &moved_m);
    let mut position_m = [0, 1].map(|axis| mean.offset_m[axis] + moved_m[axis] + map.mean.centre_m[axis]);
    let q = (!map.inducing.is_empty()).then(|| {
        let scales = &predictor.input_scales.0;
        let [width_px, height_px] = [sides[2].max(1.0), sides[3].max(1.0)];
        let raw = [sides[0], sides[1], width_px.ln(), height_px.ln()];
        let kernel =
            KernelTerms::of(map, std::array::from_fn(|at| (raw[at] - scales[at][0]) / scales[at][1]));
        let lengths = [map.lengths.place, map.lengths.size];
        for side in 0..4 {
            let by_input_m = kernel.gradient(map, side) / (lengths[side / 2].powi(2) * scales[side][1]);
            // The inputs are the foot itself, and the logarithms of width and height.
            let by_px_m = match side {
                2 => by_input_m / width_px,
                3 => by_input_m / height_px,
                _ => by_input_m,
            };
            for (axis, row) in jacobian.iter_mut().enumerate() {
                row[side] = row[side] + by_px_m.column(axis);
            }
        }
        let residual_m = kernel.correlation.matrix_product(map.inducing.len(), 2, &by_point(map));
        position_m = [0, 1].map(|axis| position_m[axis] + residual_m.column(axis));
        kernel.correlation.matrix_product(map.inducing.len(), map.rank, &map.basis)
    });
    MapTerms { tangent, q, position_m, jacobian }
}

/// East and north weight of each inducing point.
fn by_point(map: &PositionMap) -> Vec<f64> {
    let [east, north] = &map.point_weights;
    east.iter().zip(north).flat_map(|(east, north)| [*east, *north]).collect()
}

/// The kernel between boxes and inducing points, one column per point.
struct KernelTerms<'g> {
    correlation: Expr<'g>,
    /// Derivative of the correlation by half the squared scaled distance.
    slope: Expr<'g>,
    /// Differences of the inputs, by side.
    differences: Sides<'g>,
}

impl<'g> KernelTerms<'g> {
    fn of(map: &PositionMap, input: Sides<'g>) -> Self {
        let graph = input[0].graph();
        let differences: Sides<'g> = std::array::from_fn(|side| {
            let own: Vec<f64> = map.inducing.iter().map(|point| point[side]).collect();
            input[side] - graph.row(&own)
        });
        let [u, v, width, height] = differences.map(Expr::square);
        let squares = (u + v) / map.lengths.place.powi(2) + (width + height) / map.lengths.size.powi(2);
        let s = squares.sqrt() * SQRT_5;
        let decay = (-s).exp();
        Self {
            correlation: (s + s.square() / 3.0 + 1.0) * decay,
            slope: (s + 1.0) * decay * (-5.0 / 3.0),
            differences,
        }
    }

    /// Derivatives of east and north by one standardised input times its squared length scale, m.
    fn gradient(&self, map: &PositionMap, side: usize) -> Expr<'g> {
        (self.slope * self.differences[side]).matrix_product(map.inducing.len(), 2, &by_point(map))
    }
}

fn covariance_m2<'g>(map: &PositionMap, terms: &MapTerms<'g>) -> Covariance<'g> {
    let graph = terms.tangent[0].graph();
    let own_m2 = match terms.q {
        Some(q) => (map.residual_m2 - (q.square() * graph.row(&map.determined)).sum()).positive(),
        None => graph.row(&[map.residual_m2]),
    };
    let whitened: [Expr<'g>; 2] = std::array::from_fn(|axis| {
        let left = match terms.q {
            Some(q) => terms.tangent[axis] - q.matrix_product(map.rank, COEFFICIENTS, &map.absorbed[axis]),
            None => terms.tangent[axis],
        };
        left.matrix_product(COEFFICIENTS, COEFFICIENTS, &map.tangent_factor)
    });
    let [east, north] = whitened;
    let jackknife_m = jackknife_m(map, terms);
    let product = |one: usize, other: usize| jackknife_m.map(|moved| (moved[one] * moved[other]).sum());
    let own = [own_m2 + east.square().sum(), (east * north).sum(), own_m2 + north.square().sum()];
    let jackknife_m2 = [product(0, 0), product(0, 1), product(1, 1)];
    std::array::from_fn(|at| jackknife_m2[at].map_or(own[at], |jackknife_m2| own[at] + jackknife_m2))
}

/// How far each deviation of the jackknife moves east and north, one column per deviation, m.
fn jackknife_m<'g>(map: &PositionMap, terms: &MapTerms<'g>) -> Option<[Expr<'g>; 2]> {
    let count = map.deviations.len();
    let table = |rows: usize, number: &dyn Fn(&CoefficientDeviation, usize) -> f64| -> Vec<f64> {
        (0..rows).flat_map(|row| map.deviations.iter().map(move |own| number(own, row))).collect()
    };
    (count > 0).then(|| {
        std::array::from_fn(|axis| {
            let by_tangent = terms.tangent[axis].matrix_product(
                COEFFICIENTS,
                count,
                &table(COEFFICIENTS, &|own, row| own.tangent[row]),
            );
            terms.q.map_or(by_tangent, |q| {
                let by_kernel = table(map.rank, &|own, row| own.kernel[axis][row]);
                by_tangent + q.matrix_product(map.rank, count, &by_kernel)
            })
        })
    })
}

/// The projective mean at a box.
struct MeanTerms<'g> {
    /// Foot u, foot v, width and height, standardised; the sides bounded.
    scaled: Sides<'g>,
    denominator: Expr<'g>,
    /// East and north less the centre, m.
    offset_m: [Expr<'g>; 2],
}

impl<'g> MeanTerms<'g> {
    fn of(mean: &ProjectiveMean, sides: Sides<'g>) -> Self {
        let graph = sides[0].graph();
        let c = &mean.coefficients;
        let scaled: Sides<'g> = std::array::from_fn(|side| {
            let [centre_px, unit_px] = mean.scales_px[side];
            let scaled = (sides[side] - centre_px) / unit_px;
            if side < 2 { scaled } else { scaled.clamp(-MAX_SIDE, MAX_SIDE) }
        });
        let linear = |constant: f64, part: Part| {
            graph.columns(&scaled).matrix_product(4, 1, &by_side(c, part)) + constant
        };
        let denominator = linear(1.0, Part::Denominator).max(MIN_DENOMINATOR);
        let offset_m = [0, 1].map(|axis| linear(c[3 * axis], Part::Numerator(axis)) / denominator);
        Self { scaled, denominator, offset_m }
    }

    /// Derivatives of east and north by the coefficients.
    fn tangent(&self) -> [Expr<'g>; 2] {
        let graph = self.denominator.graph();
        let [u, v, width, height] = self.scaled.map(|term| term / self.denominator);
        let inverse = 1.0 / self.denominator;
        let zero = u * 0.0;
        std::array::from_fn(|axis| {
            let mut slopes = [zero; COEFFICIENTS];
            slopes[3 * axis..3 * axis + 3].copy_from_slice(&[inverse, u, v]);
            slopes[8 + 2 * axis..10 + 2 * axis].copy_from_slice(&[width, height]);
            let offset_m = -self.offset_m[axis];
            slopes[6] = offset_m * u;
            slopes[7] = offset_m * v;
            slopes[12] = offset_m * width;
            slopes[13] = offset_m * height;
            graph.columns(&slopes)
        })
    }

    /// Derivatives of east and north, with the map's step along the tangent, by foot u, foot v, width and height, m per px.
    fn jacobian(&self, map: &PositionMap, moved_m: &[Expr<'g>; 2]) -> [Sides<'g>; 2] {
        let slopes_d = by_side(&map.mean.coefficients, Part::Denominator);
        let steps_d = by_side(&map.step, Part::Denominator);
        let moved_d = self.graph_sum(&steps_d) / self.denominator;
        std::array::from_fn(|axis| {
            let slopes_n = by_side(&map.mean.coefficients, Part::Numerator(axis));
            let steps_n = by_side(&map.step, Part::Numerator(axis));
            std::array::from_fn(|side| {
                let offset_m = self.offset_m[axis];
                let scale = self.denominator * map.mean.scales_px[side][1];
                let of_ratio = (slopes_n[side] - offset_m * slopes_d[side]) / scale;
                let of_move =
                    (steps_n[side] - offset_m * steps_d[side] - moved_m[axis] * slopes_d[side]) / scale;
                of_ratio * (1.0 - moved_d) + of_move
            })
        })
    }

    /// A linear function of the standardised foot and sides.
    fn graph_sum(&self, slopes: &[f64; 4]) -> Expr<'g> {
        self.denominator.graph().columns(&self.scaled).matrix_product(4, 1, slopes)
    }
}

/// A numerator by axis, or the denominator.
#[derive(Clone, Copy)]
enum Part {
    Numerator(usize),
    Denominator,
}

/// The coefficients of foot u, foot v, width and height.
fn by_side(c: &[f64; COEFFICIENTS], part: Part) -> [f64; 4] {
    match part {
        Part::Numerator(axis) => [c[3 * axis + 1], c[3 * axis + 2], c[8 + 2 * axis], c[9 + 2 * axis]],
        Part::Denominator => [c[6], c[7], c[12], c[13]],
    }
}

/// How a box deviates from those of its cell.
struct Deviation<'g> {
    /// The numbers of the cell, one column each.
    cell: [Expr<'g>; CELL_NUMBERS],
    foot: [Expr<'g>; 2],
    /// 0 for a normal box to 1.
    weight: Expr<'g>,
}

impl<'g> Deviation<'g> {
    /// The cell's logarithms of width and height at the foot.
    fn log_sides(&self) -> [Expr<'g>; 2] {
        [0, 1].map(|side| {
            let [constant, by_u, by_v] = [0, 1, 2].map(|at| self.cell[2 + 3 * side + at]);
            constant + by_u * self.foot[0] + by_v * self.foot[1]
        })
    }
}

fn deviation<'g>(plausibility: &BoxPlausibility, sides: Sides<'g>) -> Deviation<'g> {
    let graph = sides[0].graph();
    let foot: [Expr<'g>; 2] = [0, 1].map(|side| {
        let [centre_px, unit_px] = plausibility.scales_px[side];
        (sides[side] - centre_px) / unit_px
    });
    let square = |axis: usize| {
        let own: Vec<f64> = plausibility.cells.iter().map(|cell| cell.centre[axis]).collect();
        (graph.row(&own) - foot[axis]).square()
    };
    let table: Vec<f64> = plausibility
        .cells
        .iter()
        .flat_map(|cell| {
            let coefficients = cell.coefficients.as_flattened();
            cell.centre.iter().chain(coefficients).chain(&cell.whitening).chain(&cell.leverage).copied()
        })
        .collect();
    let cell: [Expr<'g>; CELL_NUMBERS] = (square(0) + square(1)).row_of_least(CELL_NUMBERS, &table).split();
    let mut deviation = Deviation { cell, foot, weight: foot[0] };
    let [a, b, c, d, e, f] = std::array::from_fn(|at| cell[11 + at]);
    let [u, v] = foot;
    let leverage = (a + (b * u + c * v) * 2.0 + d * u.square() + e * u * v * 2.0 + f * v.square()).positive();
    let predicted = deviation.log_sides();
    let miss = [0, 1].map(|side| sides[2 + side].max(1.0).ln() - predicted[side]);
    let normalised = [cell[8] * miss[0], cell[9] * miss[0] + cell[10] * miss[1]];
    let squared = (normalised[0].square() + normalised[1].square()) / (leverage + 1.0);
    let normal = plausibility.normal[0];
    deviation.weight = (1.0 - normal / squared.max(normal)).positive();
    deviation
}

/// The box with the cell's sides whose edges are nearest to the given one's.
fn nearest_plausible<'g>(
    plausibility: &BoxPlausibility,
    sides: Sides<'g>,
    deviation: &Deviation<'g>,
) -> Sides<'g> {
    let predicted = deviation.log_sides().map(|log_px| log_px.clamp(0.0, MAX_LOG_SIDE).exp());
    let slope = |side: usize, by: usize| {
        predicted[side] * deviation.cell[2 + 3 * side + 1 + by] / plausibility.scales_px[by][1]
    };
    let slopes = [[slope(0, 0), slope(0, 1)], [slope(1, 0), slope(1, 1)]];
    let (wider, taller) = (predicted[0] - sides[2], predicted[1] - sides[3]);
    // Squares of the edges' moves as functions of the foot's; the lower edge moves by v alone.
    let edges = [
        ([1.0 - slopes[0][0] * 0.5, slopes[0][1] * -0.5], wider * -0.5),
        ([slopes[0][0] * 0.5 + 1.0, slopes[0][1] * 0.5], wider * 0.5),
        ([-slopes[1][0], 1.0 - slopes[1][1]], -taller),
    ];
    let zero = wider * 0.0;
    let (mut a, mut b, mut c, mut right) = (zero, zero, zero + 1.0, [zero; 2]);
    for ([by_u, by_v], constant) in edges {
        a = a + by_u.square();
        b = b + by_u * by_v;
        c = c + by_v.square();
        right = [right[0] - by_u * constant, right[1] - by_v * constant];
    }
    let determinant = a * c - b.square();
    let moved = [(c * right[0] - b * right[1]) / determinant, (a * right[1] - b * right[0]) / determinant];
    let side = |at: usize| (predicted[at] + slopes[at][0] * moved[0] + slopes[at][1] * moved[1]).max(1.0);
    [sides[0] + moved[0], sides[1] + moved[1], side(0), side(1)]
}

/// J E J^T.
fn quadratic<'g>(by_edge: [Sides<'g>; 2], covariance_px2: &[f64; 16]) -> Covariance<'g> {
    let graph = by_edge[0][0].graph();
    let rows = by_edge.map(|row| graph.columns(&row));
    let product =
        |one: usize, other: usize| (rows[one].matrix_product(4, 4, covariance_px2) * rows[other]).sum();
    [product(0, 0), product(0, 1), product(1, 1)]
}

/// The sum with the outer product of a vector, times a factor.
fn with_outer<'g>(
    sum: Covariance<'g>,
    [east, north]: [Expr<'g>; 2],
    factor: Option<Expr<'g>>,
) -> Covariance<'g> {
    let scaled = |product: Expr<'g>| factor.map_or(product, |factor| product * factor);
    [sum[0] + scaled(east.square()), sum[1] + scaled(east * north), sum[2] + scaled(north.square())]
}
