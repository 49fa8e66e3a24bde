// Checks numpy arrays once, where they come in: type, shape and layout, by the argument's name. Nothing is converted or
// copied: a copy of an array that is written to would be thrown away.
#pragma once

#include <pybind11/numpy.h>

#include <initializer_list>
#include <string>

namespace splatam {

namespace py = pybind11;

constexpr int kMaxThreads = 4096;
constexpr py::ssize_t kAny = -1;  // a size that is not checked
using Shape = std::initializer_list<py::ssize_t>;

inline std::string text_of(Shape shape) {
  std::string text = "(";
  for (const py::ssize_t size : shape)
    text += (text.size() > 1 ? ", " : "") + (size == kAny ? "n" : std::to_string(size));
  return text + ")";
}

template <typename T>
[[noreturn]] void refuse(const py::handle& given, const char* name, Shape shape, const char* layout) {
  const auto text = [](const py::handle& value) { return std::string(py::str(value)); };
  std::string found = text(py::type::of(given).attr("__name__"));
  if (py::isinstance<py::array>(given))
    found =
        text(given.attr("shape")) + " " + text(given.attr("dtype")) + " with strides " + text(given.attr("strides"));
  throw py::type_error(std::string(name) + " is " + found + "; expected " + text_of(shape) + " " +
                       text(py::dtype::of<T>()) + layout);
}

// Returns an array of this type and shape, of any strides.
template <typename T>
py::array checked(const py::handle& given, const char* name, Shape shape, const char* layout = "") {
  const auto is_one = [&] {
    if (!py::isinstance<py::array>(given)) return false;
    const auto array = py::reinterpret_borrow<py::array>(given);
    if (!py::isinstance<py::array_t<T>>(given) || array.ndim() != py::ssize_t(shape.size())) return false;
    const py::ssize_t* size = array.shape();
    for (const py::ssize_t expected : shape)
      if (const py::ssize_t found = *size++; expected != kAny && expected != found) return false;
    return true;
  };
  if (!is_one()) refuse<T>(given, name, shape, layout);
  return py::reinterpret_borrow<py::array>(given);
}

// Returns the values of a C-contiguous, aligned array that is only read.
template <typename T>
const T* values(const py::handle& given, const char* name, Shape shape) {
  constexpr const char* kLayout = ", C-contiguous";
  const py::array array = checked<T>(given, name, shape, kLayout);
  constexpr int kNeeded = py::detail::npy_api::NPY_ARRAY_C_CONTIGUOUS_ | py::detail::npy_api::NPY_ARRAY_ALIGNED_;
  if ((array.flags() & kNeeded) != kNeeded) refuse<T>(given, name, shape, kLayout);
  return static_cast<const T*>(array.data());
}

// The same of an array that is written to.
template <typename T>
T* written(const py::handle& given, const char* name, Shape shape) {
  const T* data = values<T>(given, name, shape);
  if (!py::reinterpret_borrow<py::array>(given).writeable()) refuse<T>(given, name, shape, ", writeable");
  return const_cast<T*>(data);
}

template <typename T>
T* written_or_null(const py::handle& given, const char* name, Shape shape) {
  return given.is_none() ? nullptr : written<T>(given, name, shape);
}

inline int checked_threads(int threads) {
  if (threads < 1 || threads > kMaxThreads)
    throw py::value_error("threads is " + std::to_string(threads) + "; expected 1 to " + std::to_string(kMaxThreads));
  return threads;
}

// Returns the length of an array's first axis.
inline py::ssize_t length_of(const py::handle& given, const char* name) {
  if (!py::isinstance<py::array>(given) || py::reinterpret_borrow<py::array>(given).ndim() == 0)
    throw py::type_error(std::string(name) + " is " + std::string(py::str(py::type::of(given).attr("__name__"))) +
                         "; expected an array of at least one dimension");
  return py::reinterpret_borrow<py::array>(given).shape(0);
}

}  // namespace splatam
