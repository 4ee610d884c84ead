-- ================================================================================================
-- rosbayes: bm1_stochastic_bitstream_generator
-- Turns a probability code into a random bit by comparing it with a random number.
-- MIT licence; datasheet: docs/hardware/bm1_stochastic_bitstream_generator.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

entity bm1_stochastic_bitstream_generator is
  generic (
    PROB_BITS : positive -- width of a probability code
  );
  port (
    random_i : in    std_logic_vector(PROB_BITS - 1 downto 0); -- random number from the generator
    code_i   : in    std_logic_vector(PROB_BITS - 1 downto 0); -- probability code; 0 gives no 1s, all ones gives only 1s
    bit_o    : out   std_logic;                                -- random bit
    never_o  : out   std_logic                                 -- the code is 0
  );
end entity bm1_stochastic_bitstream_generator;

architecture rtl of bm1_stochastic_bitstream_generator is

begin

  bit_o <= '1' when unsigned(random_i) < unsigned(code_i) or (and code_i) = '1' else
           '0';

  never_o <= not (or code_i);

end architecture rtl;
