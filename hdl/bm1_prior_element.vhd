-- ================================================================================================
-- rosbayes: bm1_prior_element
-- First cell of a line: makes the stochastic bitstream of P(S) (thesis, figure 2.1).
-- MIT licence; datasheet: docs/hardware/bm1_prior_element.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

entity bm1_prior_element is
  generic (
    PROB_BITS : positive; -- width of a probability code
    WRITTEN   : boolean   -- true: the host writes the code; false: the code is in the prior's table
  );
  port (
    clk_i    : in    std_logic;                                -- clock
    load_i   : in    std_logic;                                -- latch the written code at the start of a frame
    code_i   : in    std_logic_vector(PROB_BITS - 1 downto 0); -- code from the prior's table, or from the host
    random_i : in    std_logic_vector(PROB_BITS - 1 downto 0); -- random number of column 0
    bit_o    : out   std_logic;                                -- bitstream of P(S)
    never_o  : out   std_logic                                 -- the bitstream is all zeros
  );
end entity bm1_prior_element;

architecture rtl of bm1_prior_element is

  signal code : std_logic_vector(PROB_BITS - 1 downto 0);

begin

  written_code : if WRITTEN generate
    -- The host may write the next prior between two slices of a frame, so the frame needs a copy.

    hold_code : process (clk_i) is
    begin

      if rising_edge(clk_i) then
        if (load_i = '1') then
          code <= code_i;
        end if;
      end if;

    end process hold_code;

  else generate
    code <= code_i;
  end generate written_code;

  generator : entity work.bm1_stochastic_bitstream_generator
    generic map (
      prob_bits => PROB_BITS
    )
    port map (
      random_i => random_i,
      code_i   => code,
      bit_o    => bit_o,
      never_o  => never_o
    );

end architecture rtl;
