// The engine and the aligner as Python sees them (splatam_core/_native.pyi): numpy arrays in, numpy arrays out, no
// copies, the GIL released.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>

#include "aligner.hpp"
#include "arrays.hpp"
#include "blender_bindings.hpp"
#include "block_cholesky.hpp"
#include "descent.hpp"
#include "engine.hpp"
#include "matcher_bindings.hpp"
#include "weigh.hpp"

namespace py = pybind11;
using Array = py::array_t<float, py::array::c_style>;

namespace splatam {
namespace {

struct Size {
  py::ssize_t width, height;
};

// Returns the size of an image [H, W].
Size size_of(const py::handle& image, const char* name) {
  const py::array array = checked<float>(image, name, {kAny, kAny});
  const Size size{array.shape(1), array.shape(0)};
  if (size.width > kMaxSide || size.height > kMaxSide) check_size(kMaxSide + 1, kMaxSide + 1);
  check_size(int(size.width), int(size.height));
  return size;
}

// Intrinsics of a PinholeCamera, and the size of the image it is used for.
Camera camera_of(const py::object& camera, Size size) {
  const auto intrinsic = [&](const char* name) {
    if (!py::hasattr(camera, name))
      throw py::type_error(std::string("camera has no ") + name + "; expected a PinholeCamera");
    return camera.attr(name).cast<float>();
  };
  return {int(size.width), int(size.height), intrinsic("fx"), intrinsic("fy"), intrinsic("cx"), intrinsic("cy")};
}

Pose pose_of(const py::handle& given, const char* name) {
  const py::array_t<float> T = checked<float>(given, name, {4, 4});
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) pose.R[3 * row + column] = T.at(row, column);
    pose.t[row] = T.at(row, 3);
  }
  return pose;
}

py::ssize_t blocks_of(py::ssize_t count) { return (count + py::ssize_t(kBlock) - 1) / py::ssize_t(kBlock); }

// The Gaussians as a call is given them.
struct GivenGaussians {
  py::object means, log_scales, logit_opacities, rgb;

  py::ssize_t count() const { return length_of(means, "means"); }

  GaussianArrays read() const {
    const py::ssize_t n = count();
    return {values<float>(means, "means", {n, 3}), values<float>(log_scales, "log_scales", {n, 1}),
            values<float>(logit_opacities, "logit_opacities", {n}), values<float>(rgb, "rgb", {n, 3})};
  }

  MutableGaussians write() const {
    const py::ssize_t n = count();
    return {written<float>(means, "means", {n, 3}), written<float>(log_scales, "log_scales", {n, 1}),
            written<float>(logit_opacities, "logit_opacities", {n}), written<float>(rgb, "rgb", {n, 3})};
  }
};

std::shared_ptr<View> forward(Engine& engine, const py::object& means, const py::object& log_scales,
                              const py::object& logit_opacities, const py::object& rgb, const py::object& bounds,
                              const py::object& T_cam_world, const py::object& camera, const py::object& image,
                              const py::object& depth, const py::object& silhouette) {
  const GivenGaussians given{means, log_scales, logit_opacities, rgb};
  const GaussianArrays gaussians = given.read();
  const auto count = std::size_t(given.count());
  const Size size = size_of(depth, "depth");
  const Camera pinhole = camera_of(camera, size);
  const Pose pose = pose_of(T_cam_world, "T_cam_world");
  const Images images{written<float>(image, "image", {3, size.height, size.width}),
                      written<float>(depth, "depth", {size.height, size.width}),
                      written<float>(silhouette, "silhouette", {size.height, size.width})};
  const float* limits =
      bounds.is_none() ? nullptr : values<float>(bounds, "bounds", {blocks_of(given.count()), kBounds});
  py::gil_scoped_release release;
  return engine.forward(gaussians, count, limits, pinhole, pose, images);
}

// Three images of a view: colour, depth and silhouette.
ConstImages images_of(const std::array<py::object, 3>& images, const char* name, const Camera& camera) {
  const py::ssize_t width = camera.width, height = camera.height;
  const std::string names[3] = {std::string(name) + "[0]", std::string(name) + "[1]", std::string(name) + "[2]"};
  return {values<float>(images[0], names[0].c_str(), {3, height, width}),
          values<float>(images[1], names[1].c_str(), {height, width}),
          values<float>(images[2], names[2].c_str(), {height, width})};
}

void backward(Engine& engine, View& view, const py::object& means, const py::object& log_scales,
              const py::object& logit_opacities, const py::object& rgb,
              const std::array<py::object, 3>& image_gradients, const py::object& means_gradient,
              const py::object& log_scales_gradient, const py::object& logit_opacities_gradient,
              const py::object& rgb_gradient, const py::object& pose_gradient) {
  const auto n = py::ssize_t(view.num_gaussians);
  values<float>(means, "means", {n, 3});  // as many as the view was drawn of
  const GaussianArrays gaussians = GivenGaussians{means, log_scales, logit_opacities, rgb}.read();
  const ConstImages gradients = images_of(image_gradients, "image_gradients", view.camera);
  const MapGradients map{written_or_null<float>(means_gradient, "means_gradient", {n, 3}),
                         written_or_null<float>(log_scales_gradient, "log_scales_gradient", {n, 1}),
                         written_or_null<float>(logit_opacities_gradient, "logit_opacities_gradient", {n}),
                         written_or_null<float>(rgb_gradient, "rgb_gradient", {n, 3})};
  float* pose = written<float>(pose_gradient, "pose_gradient", {4, 4});
  py::gil_scoped_release release;
  engine.backward(view, gaussians, gradients, map, pose);
}

double fit(Engine& engine, const py::object& means, const py::object& log_scales, const py::object& logit_opacities,
           const py::object& rgb, const py::object& bounds, const py::object& moments, const py::object& steps,
           const std::array<float, 4>& rates, const py::object& T_cam_world, const py::object& camera,
           const py::object& target_rgb, const py::object& target_depth, float color_weight, float depth_weight,
           float color_limit, float depth_limit, float enough) {
  const GivenGaussians given{means, log_scales, logit_opacities, rgb};
  const MutableGaussians gaussians = given.write();
  const py::ssize_t n = given.count();
  const Size size = size_of(target_depth, "target_depth");
  const Camera pinhole = camera_of(camera, size);
  const Pose pose = pose_of(T_cam_world, "T_cam_world");
  const AdamState adam{written<float>(moments, "moments", {n, 16}), written<std::uint8_t>(steps, "steps", {n})};
  const AdamRates step_sizes{rates[0], rates[1], rates[2], rates[3]};
  const Target target{values<std::uint8_t>(target_rgb, "target_rgb", {size.height, size.width, 3}),
                      values<float>(target_depth, "target_depth", {size.height, size.width}),
                      color_weight,
                      depth_weight,
                      color_limit,
                      depth_limit,
                      enough};
  float* limits = written_or_null<float>(bounds, "bounds", {blocks_of(n), kBounds});
  py::gil_scoped_release release;
  return engine.fit(gaussians, std::size_t(n), limits, adam, step_sizes, pinhole, pose, target);
}

// Aligner::Result as Python sees it.
struct LinearSystem {
  py::array_t<double> H, g, H_by_time, H_by_time_squared, g_by_time;  // [kUnknowns, kUnknowns], [kUnknowns]
  double cost;
  std::int64_t points, compared, seen, agreeing;
  float photometric_median, depth_median;
};

// Expands the upper triangle of a symmetric matrix.
py::array_t<double> symmetric(const double* triangle) {
  py::array_t<double> whole({kUnknowns, kUnknowns});
  auto entries = whole.mutable_unchecked<2>();
  for (int row = 0; row < kUnknowns; ++row)
    for (int column = row; column < kUnknowns; ++column) entries(row, column) = entries(column, row) = *triangle++;
  return whole;
}

// Images [H, W] of a level, and their size.
struct GivenLevel {
  Size size;
  const float *brightness, *depth;
};

GivenLevel level_of(const py::object& brightness, const py::object& depth) {
  const Size size = size_of(brightness, "brightness");
  return {size, values<float>(brightness, "brightness", {size.height, size.width}),
          values<float>(depth, "depth", {size.height, size.width})};
}

// A dataclass of splatam_core/tracking, and its attributes.
struct Given {
  py::object object;
  const char *name, *type;

  py::object member(const char* attribute) const {
    if (!py::hasattr(object, attribute))
      throw py::type_error(std::string(name) + " has no " + attribute + "; expected " + type);
    return object.attr(attribute);
  }

  template <typename T = float>
  T number(const char* attribute) const {
    try {
      return member(attribute).cast<T>();
    } catch (const py::cast_error&) {
      throw py::type_error(std::string(attribute) + " is no number; expected " +
                           (std::is_integral_v<T> ? "an int" : "a float"));
    }
  }

  template <typename T>
  void copy(const char* attribute, T* to, py::ssize_t count) const {
    const py::object array = member(attribute);
    const T* from = values<T>(array, attribute, {count});
    if constexpr (std::is_same_v<T, bool>)  // numpy takes every byte but 0 for True, C++ only 1
      std::transform(reinterpret_cast<const unsigned char*>(from), reinterpret_cast<const unsigned char*>(from) + count,
                     to, [](unsigned char byte) { return byte != 0; });
    else
      std::copy_n(from, count, to);
  }
};

Motion motion_of(const py::handle& given, const char* name) {
  const py::array_t<double> T = checked<double>(given, name, {4, 4});
  Motion motion;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) motion.R[row][column] = T.at(row, column);
    motion.t[row] = T.at(row, 3);
  }
  return motion;
}

py::array_t<double> array_of(const Motion& motion) {
  py::array_t<double> T({4, 4});
  auto entries = T.mutable_unchecked<2>();
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) entries(row, column) = motion.R[row][column];
    entries(row, 3) = motion.t[row], entries(3, row) = 0.0;
  }
  entries(3, 3) = 1.0;
  return T;
}

// The images of a Linearization or a Descent, checked. It holds the arrays.
struct GivenImages {
  explicit GivenImages(const Given& at)
      : brightness(at.member("brightness")), depth(at.member("depth")), layers(at.member("layers")) {
    const GivenLevel level = level_of(brightness, depth);
    images.brightness = level.brightness, images.depth = level.depth;
    images.layers = values<float>(layers, "layers", {level.size.height, level.size.width, kLayers});
    images.camera = camera_of(at.member("camera"), level.size);
    images.settings.max_depth_ratio = at.number("max_depth_ratio");
  }

  py::object brightness, depth, layers;
  Aligned images{};
};

struct GivenLinearization : GivenImages {
  explicit GivenLinearization(const py::object& object) : GivenLinearization(Given{object, "at", "a Linearization"}) {}
  explicit GivenLinearization(const Given& at) : GivenImages(at) {
    images.color_motion = pose_of(at.member("color_motion"), "color_motion");
    images.depth_motion = pose_of(at.member("depth_motion"), "depth_motion");
    AlignmentSettings& settings = images.settings;
    settings.gain = at.number("gain"), settings.bias = at.number("bias");
    at.copy("velocity", settings.velocity, 6), at.copy("readout", images.readout, 6);
    settings.photometric_scale = at.number("photometric_scale"), settings.depth_scale = at.number("depth_scale");
  }
};

LinearSystem linearize(Aligner& aligner, const py::object& at, float inlier_color, float inlier_depth) {
  GivenLinearization given(at);
  given.images.settings.inlier_color = inlier_color, given.images.settings.inlier_depth = inlier_depth;
  Aligner::Result result;
  {
    py::gil_scoped_release release;
    result = aligner.linearize(given.images);
  }
  const auto& sums = result.sums;
  const auto& moments = result.moments;
  LinearSystem system;
  system.H = symmetric(sums.H), system.g = py::array_t<double>(kUnknowns, sums.g);
  system.H_by_time = symmetric(moments.H1), system.H_by_time_squared = symmetric(moments.H2);
  system.g_by_time = py::array_t<double>(kUnknowns, moments.g1);
  system.cost = sums.cost, system.points = sums.points, system.compared = sums.compared;
  system.seen = sums.seen, system.agreeing = sums.agreeing;
  system.photometric_median = result.photometric_median, system.depth_median = result.depth_median;
  return system;
}

// A Descent, checked.
struct GivenDescent : GivenImages {
  explicit GivenDescent(const Given& task) : GivenImages(task) {
    descent.images = images;
    const py::object predicted = task.member("predicted_motion");
    descent.is_motion_known = !predicted.is_none();
    if (descent.is_motion_known) descent.predicted_motion = motion_of(predicted, "predicted_motion");
    const Given pace{task.member("pace"), "pace", "a Pace"};
    descent.pace.num_frames = pace.number<int>("num_frames");
    pace.copy("expected", descent.pace.expected, 6);
    descent.pace.limit_m = pace.number<double>("limit_m"), descent.pace.limit_rad = pace.number<double>("limit_rad");
    if (!(descent.pace.num_frames > 0 && descent.pace.limit_m > 0 && descent.pace.limit_rad > 0))
      throw py::value_error("num_frames, limit_m and limit_rad of pace are expected to be greater than 0");
    task.copy("mean", descent.mean, kAllUnknowns), task.copy("information", descent.information, kAllUnknowns);
    task.copy("scale_factors", descent.scale_factors, 2);
    task.copy("is_free", descent.is_free, kAllUnknowns);
    descent.iterations = task.number<int>("iterations"), descent.small_step = task.number<double>("small_step");
  }

  Descent descent{};
};

AlignmentState state_of(const Given& start) {
  AlignmentState state{};
  state.depth_motion = motion_of(start.member("depth_motion"), "depth_motion");
  state.gain = start.number<double>("gain"), state.bias = start.number<double>("bias");
  state.time_offset = start.number<double>("time_offset"), state.readout = start.number<double>("readout");
  start.copy("velocity", state.velocity, 6), start.copy("scales", state.scales, 2);
  return state;
}

// Returns a state of the class of the start.
py::object descend_from(Aligner& aligner, const py::object& task, const py::object& start) {
  const GivenDescent given(Given{task, "task", "a Descent"});
  AlignmentState state = state_of(Given{start, "start", "an AlignmentState"});
  {
    py::gil_scoped_release release;
    state = descend(aligner, given.descent, state);
  }
  using namespace py::literals;
  return py::type::of(start)("depth_motion"_a = array_of(state.depth_motion), "gain"_a = state.gain,
                             "bias"_a = state.bias, "time_offset"_a = state.time_offset,
                             "velocity"_a = py::array_t<double>(6, state.velocity), "readout"_a = state.readout,
                             "scales"_a = py::array_t<double>(2, state.scales));
}

// Aligner::Evidence as Python sees it.
struct EvidenceOfView {
  py::array_t<double> claimed, shared, scores, cells;
};

template <std::size_t rows, std::size_t columns>
py::array_t<double> matrix(const double (&entries)[rows][columns]) {
  return py::array_t<double>({rows, columns}, &entries[0][0]);
}

EvidenceOfView evidence(Aligner& aligner, const py::object& at, float max_depth_error, int step) {
  if (step < 1) throw py::value_error("step is " + std::to_string(step) + "; expected at least 1");
  GivenLinearization given(at);
  given.images.max_depth_error = max_depth_error, given.images.step = step;
  Aligner::Evidence found;
  {
    py::gil_scoped_release release;
    found = aligner.evidence(given.images);
  }
  return {matrix(found.claimed), matrix(found.shared), matrix(found.scores), matrix(found.cells)};
}

// EvidenceSums of either aligner, copied.
Aligner::Evidence sums_of(const Given& given) {
  Aligner::Evidence sums;
  const auto copy = [&](const char* name, auto& to) {
    constexpr py::ssize_t kColumns = std::extent_v<std::remove_reference_t<decltype(to)>, 1>;
    const py::object array = given.member(name);
    std::copy_n(values<double>(array, name, {kUnknowns, kColumns}), kUnknowns * kColumns, &to[0][0]);
  };
  copy("claimed", sums.claimed), copy("shared", sums.shared), copy("scores", sums.scores), copy("cells", sums.cells);
  return sums;
}

// PoseWeight as Python sees it.
struct WeightOfPose {
  py::array_t<double> covariance;
  int num_open;
  double explained;
  int num_explained;
};

WeightOfPose weigh_sums(Aligner&, const py::object& given_sums, const py::object& given_known) {
  const Aligner::Evidence sums = sums_of(Given{given_sums, "sums", "EvidenceSums"});
  const Given given{given_known, "known", "Knowns"}, camera{given.member("camera"), "camera", "a PinholeCamera"};
  Knowns known{camera.number<int>("width"), camera.number<int>("height"), given.number<int>("step")};
  check_size(known.width, known.height);
  if (known.step < 1) throw py::value_error("step is " + std::to_string(known.step) + "; expected at least 1");
  given.copy("velocity", known.velocity, 6), given.copy("prior", known.prior, kUnknowns);
  given.copy("is_free", known.is_free, kUnknowns);
  known.prior_inflation = given.number<double>("prior_inflation");
  PoseWeight weight;
  {
    py::gil_scoped_release release;
    weight = weigh(sums, known);
  }
  return {matrix(weight.covariance), weight.num_open, weight.explained, weight.num_explained};
}

py::tuple halve(Aligner& aligner, const py::object& brightness, const py::object& depth, float max_step) {
  const GivenLevel level = level_of(brightness, depth);
  const int width = int(level.size.width), height = int(level.size.height);
  Array half_brightness({height / 2, width / 2}), half_depth({height / 2, width / 2});
  float *brightness_out = half_brightness.mutable_data(), *depth_out = half_depth.mutable_data();
  {
    py::gil_scoped_release release;
    aligner.halve(level.brightness, level.depth, width, height, max_step, brightness_out, depth_out);
  }
  return py::make_tuple(half_brightness, half_depth);
}

py::tuple frame_images(Aligner& aligner, const py::object& rgb8, const py::object& depth, int max_gap, float max_step) {
  const Size size = size_of(depth, "depth");
  const float* readings = values<float>(depth, "depth", {size.height, size.width});
  const std::uint8_t* colors = values<std::uint8_t>(rgb8, "rgb8", {size.height, size.width, 3});
  Array brightness({size.height, size.width}), filled({size.height, size.width});
  float *brightness_out = brightness.mutable_data(), *depth_out = filled.mutable_data();
  {
    py::gil_scoped_release release;
    aligner.frame_images(colors, readings, int(size.width), int(size.height), max_gap, max_step, brightness_out,
                         depth_out);
  }
  return py::make_tuple(brightness, filled);
}

py::tuple render_images(Aligner& aligner, const py::object& rgb, const py::object& depth_acc,
                        const py::object& silhouette, float threshold, float least) {
  const Size size = size_of(depth_acc, "depth_acc");
  const ConstImages drawn{values<float>(rgb, "rgb", {3, size.height, size.width}),
                          values<float>(depth_acc, "depth_acc", {size.height, size.width}),
                          values<float>(silhouette, "silhouette", {size.height, size.width})};
  Array brightness({size.height, size.width}), depth({size.height, size.width});
  float *brightness_out = brightness.mutable_data(), *depth_out = depth.mutable_data();
  {
    py::gil_scoped_release release;
    aligner.render_images(drawn, int(size.width), int(size.height), threshold, least, brightness_out, depth_out);
  }
  return py::make_tuple(brightness, depth);
}

Array layers(Aligner& aligner, const py::object& brightness, const py::object& depth, float max_step) {
  const GivenLevel level = level_of(brightness, depth);
  const int width = int(level.size.width), height = int(level.size.height);
  Array result({height, width, kLayers});
  float* data = result.mutable_data();
  {
    py::gil_scoped_release release;
    aligner.layers(level.brightness, level.depth, width, height, max_step, data);
  }
  return result;
}

void solve_in_place(const py::object& place, const py::object& blocks, const py::object& right_hand_side) {
  const py::ssize_t size = length_of(right_hand_side, "right_hand_side"), count = length_of(place, "place");
  const BlockMatrix matrix{std::size_t(size), std::size_t(count), values<std::int32_t>(place, "place", {count, 2}),
                           values<double>(blocks, "blocks", {count, kPoseSize, kPoseSize})};
  double* x = written<double>(right_hand_side, "right_hand_side", {size, kPoseSize});
  for (py::ssize_t k = 0; k < count; ++k) {
    const std::int32_t row = matrix.place[2 * k], column = matrix.place[2 * k + 1];
    if (column < 0 || row < column || row >= size)
      throw py::value_error("place[" + std::to_string(k) + "] is (" + std::to_string(row) + ", " +
                            std::to_string(column) + "); expected a block of the lower triangle");
  }
  bool is_solved = false;
  {
    py::gil_scoped_release release;
    is_solved = solve_blocks(matrix, x);
  }
  if (!is_solved) throw py::value_error("the matrix is not positive definite");
}

void bind_engine(py::module_& module) {
  py::class_<View, std::shared_ptr<View>>(module, "View");
  py::class_<Engine, std::shared_ptr<Engine>>(module, "Engine")
      .def(py::init([](int threads) { return std::make_shared<Engine>(checked_threads(threads)); }), py::arg("threads"))
      .def_property_readonly("instruction_set", &Engine::instruction_set)
      .def("forward", &forward, py::kw_only(), py::arg("means"), py::arg("log_scales"), py::arg("logit_opacities"),
           py::arg("rgb"), py::arg("bounds"), py::arg("T_cam_world"), py::arg("camera"), py::arg("image"),
           py::arg("depth"), py::arg("silhouette"))
      .def("backward", &backward, py::arg("view"), py::kw_only(), py::arg("means"), py::arg("log_scales"),
           py::arg("logit_opacities"), py::arg("rgb"), py::arg("image_gradients"), py::arg("means_gradient"),
           py::arg("log_scales_gradient"), py::arg("logit_opacities_gradient"), py::arg("rgb_gradient"),
           py::arg("pose_gradient"))
      .def("fit", &fit, py::kw_only(), py::arg("means"), py::arg("log_scales"), py::arg("logit_opacities"),
           py::arg("rgb"), py::arg("bounds"), py::arg("moments"), py::arg("steps"), py::arg("rates"),
           py::arg("T_cam_world"), py::arg("camera"), py::arg("target_rgb"), py::arg("target_depth"),
           py::arg("color_weight"), py::arg("depth_weight"), py::arg("color_limit"), py::arg("depth_limit"),
           py::arg("enough"));
}

void bind_aligner(py::module_& module) {
  py::class_<LinearSystem>(module, "LinearSystem")
      .def_readonly("H", &LinearSystem::H)
      .def_readonly("g", &LinearSystem::g)
      .def_readonly("H_by_time", &LinearSystem::H_by_time)
      .def_readonly("H_by_time_squared", &LinearSystem::H_by_time_squared)
      .def_readonly("g_by_time", &LinearSystem::g_by_time)
      .def_readonly("cost", &LinearSystem::cost)
      .def_readonly("points", &LinearSystem::points)
      .def_readonly("compared", &LinearSystem::compared)
      .def_readonly("seen", &LinearSystem::seen)
      .def_readonly("agreeing", &LinearSystem::agreeing)
      .def_readonly("photometric_median", &LinearSystem::photometric_median)
      .def_readonly("depth_median", &LinearSystem::depth_median);
  py::class_<EvidenceOfView>(module, "EvidenceSums")
      .def_readonly("claimed", &EvidenceOfView::claimed)
      .def_readonly("shared", &EvidenceOfView::shared)
      .def_readonly("scores", &EvidenceOfView::scores)
      .def_readonly("cells", &EvidenceOfView::cells);
  py::class_<WeightOfPose>(module, "PoseWeight")
      .def_readonly("covariance", &WeightOfPose::covariance)
      .def_readonly("num_open", &WeightOfPose::num_open)
      .def_readonly("explained", &WeightOfPose::explained)
      .def_readonly("num_explained", &WeightOfPose::num_explained);
  py::class_<Aligner>(module, "Aligner")
      .def(py::init([](int threads) { return std::make_unique<Aligner>(checked_threads(threads)); }),
           py::arg("threads"))
      .def("linearize", &linearize, py::arg("at"), py::kw_only(), py::arg("inlier_color"), py::arg("inlier_depth"))
      .def("descend", &descend_from, py::arg("task"), py::arg("start"))
      .def("evidence", &evidence, py::arg("at"), py::kw_only(), py::arg("max_depth_error"), py::arg("step"))
      .def("weigh", &weigh_sums, py::arg("sums"), py::arg("known"))
      .def("halve", &halve, py::arg("brightness"), py::arg("depth"), py::arg("max_step"))
      .def("frame_images", &frame_images, py::arg("rgb8"), py::arg("depth"), py::arg("max_gap"), py::arg("max_step"))
      .def("render_images", &render_images, py::arg("rgb"), py::arg("depth_acc"), py::arg("silhouette"),
           py::arg("threshold"), py::arg("least"))
      .def("layers", &layers, py::arg("brightness"), py::arg("depth"), py::arg("max_step"));
}

}  // namespace
}  // namespace splatam

PYBIND11_MODULE(_native, module) {
  using namespace splatam;
  module.doc() = "The CPU rasterizer's and the alignment's kernels.";
  module.attr("BLOCK") = kBlock;
  py::register_exception<TooLarge>(module, "TooLargeError", PyExc_ValueError);
  const py::object no_solution = py::module_::import("numpy.linalg").attr("LinAlgError");
  py::register_exception<Undetermined>(module, "UndeterminedError", no_solution);
  bind_engine(module);
  bind_aligner(module);
  bind_blender(module);
  bind_matcher(module);
  module.def("solve_blocks", &solve_in_place, py::arg("place"), py::arg("blocks"), py::arg("right_hand_side"));
}
